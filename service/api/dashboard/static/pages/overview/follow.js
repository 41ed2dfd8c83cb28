// Periodic updates. After an error the last state stays visible and is marked as outdated.

import { h, refresh } from "../../dom.js";
import { when } from "../../format.js";
import { errorBox, repeat } from "../../ui.js";

const lastContents = new WeakMap();

/**
 * Run `look(signal)` every `seconds` until the signal aborts. `place` shows an error and the time of the last update.
 * If the key is missing or insufficient, stop: the dialog would open again and again.
 */
export function follow(seconds, place, signal, look) {
  const own = new AbortController();
  const until = AbortSignal.any([signal, own.signal]);
  const note = h("div");
  let last = null;
  place.append(note);
  return repeat(
    seconds,
    async () => {
      try {
        await look(until);
        last = new Date();
        note.replaceChildren();
      } catch (error) {
        if (signal.aborted || error.name === "AbortError") return;
        const closed = error.status === 401 || error.status === 403;
        const again = () => {
          note.remove();
          follow(seconds, place, signal, look);
        };
        if (closed) own.abort();
        if (error.name !== "ApiError") console.error(error);
        // another update already shows this error
        if (!closed && place.querySelector(".error") && !note.firstChild) return;
        refresh(
          note,
          errorBox(error, closed ? again : null),
          last ? h("p", { class: "hint" }, `Last update: ${when(last.toISOString())}.`) : null,
        );
      }
    },
    until,
  );
}

/** Return whether contents differ from those of the last call, so that unchanged ones keep focus and selection. */
export function changed(place, what) {
  const text = JSON.stringify(what);
  if (lastContents.get(place) === text) return false;
  lastContents.set(place, text);
  return true;
}
