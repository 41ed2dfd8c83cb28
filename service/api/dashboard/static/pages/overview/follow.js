// Looks at something again and again. What cannot be looked at any more is still shown, and said to be old.

import { h, refresh } from "../../dom.js";
import { when } from "../../format.js";
import { errorBox, every } from "../../ui.js";

const told = new WeakMap();

/**
 * Do `look(signal)` every so many seconds until the signal aborts. Where it fails, `place` says so, and since when what
 * is shown is old. Where a key is missing or not enough, it stops: it would ask for one again and again.
 */
export function follow(seconds, place, signal, look) {
  const own = new AbortController();
  const until = AbortSignal.any([signal, own.signal]);
  const note = h("div");
  let last = null;
  place.append(note);
  return every(
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
        // beside a second one that says the same it would only take room
        if (!closed && place.querySelector(".error") && !note.firstChild) return;
        refresh(
          note,
          errorBox(error, closed ? again : null),
          last ? h("p", { class: "hint" }, `What is shown below is as of ${when(last.toISOString())}.`) : null,
        );
      }
    },
    until,
  );
}

/** Show something only where it is not what was shown last: nobody loses the focus or a selection to a repetition. */
export function changed(place, what) {
  const text = JSON.stringify(what);
  if (told.get(place) === text) return false;
  told.set(place, text);
  return true;
}
