// Live health: what /health/ready says of each part, without a key.

import { get } from "../../api.js";
import { h, refresh, replace } from "../../dom.js";
import { when } from "../../format.js";
import { badge, every } from "../../ui.js";
import { changed } from "./follow.js";

/** Keep the card up to date until the signal aborts. */
export function health(place, seconds, signal) {
  const state = h("span", { role: "status" }, badge("asking", "plain"));
  const since = h("span", { class: "hint" });
  const parts = h("ul", { class: "parts" });
  const version = h("span", { class: "muted" });
  replace(
    place,
    h(
      "section",
      { class: "card", "aria-labelledby": "health" },
      h("div", { class: "heading" }, h("div", { class: "row" }, h("h2", { id: "health" }, "Health"), state, version), since),
      parts,
    ),
  );
  let answered = null;
  const show = (word, kind, checks) => {
    if (!changed(parts, [word, checks])) return;
    refresh(state, badge(word, kind));
    refresh(parts, checks.map(part));
  };
  return every(
    seconds,
    async () => {
      try {
        const ready = await get("/health/ready", {}, signal);
        version.textContent = `LIPServe ${ready.version}`;
        const warned = ready.checks.some((check) => check.state !== "ok");
        show(warned ? "ready, with warnings" : "ready", warned ? "warn" : "good", ready.checks);
        answered = new Date();
        since.textContent = "checked every 2 s";
      } catch (error) {
        if (signal.aborted || error.name === "AbortError") return;
        if (error.status === 503 && error.detail?.length) {
          const failed = error.detail.map((item) => ({ name: item.field, state: "failed", message: item.value }));
          show("not ready", "bad", failed);
          answered = new Date();
          since.textContent = "checked every 2 s";
        } else {
          show("no answer", "bad", [{ name: "service", state: "failed", message: error.message }]);
          since.textContent = answered ? `last answer ${when(answered.toISOString())}; checked every 2 s` : "checked every 2 s";
        }
      }
    },
    signal,
  );
}

function part({ name, state, message }) {
  return h("li", {}, badge(state), " ", h("strong", {}, name), " ", h("span", { class: "muted" }, String(message)));
}
