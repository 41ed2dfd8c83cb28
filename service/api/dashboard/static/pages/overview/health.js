// Health of the service in one line, and its failed checks. /health/ready needs no key.

import { get } from "../../api.js";
import { h, refresh, replace } from "../../dom.js";
import { when } from "../../format.js";
import { badge, repeat } from "../../ui.js";
import { changed } from "./follow.js";

/** Update the health until the signal aborts. */
export function health(place, seconds, signal) {
  const state = h("span", { role: "status" }, badge("checking", "plain"));
  const since = h("span", { class: "hint" });
  const wrong = h("ul", { class: "parts" }), all = h("ul", { class: "parts" });
  const version = h("span", { class: "muted" });
  replace(
    place,
    h(
      "section",
      { class: "health", "aria-labelledby": "health" },
      h("div", { class: "row" }, h("h2", { id: "health" }, "Health"), state, version, since),
      wrong,
      h("details", {}, h("summary", {}, "All checks"), all),
    ),
  );
  let answered = null;
  const show = (word, kind, checks) => {
    if (!changed(all, [word, checks])) return;
    refresh(state, badge(word, kind));
    refresh(wrong, checks.filter((check) => check.state !== "ok").map(part));
    refresh(all, checks.map(part));
  };
  return repeat(
    seconds,
    async () => {
      try {
        const ready = await get("/health/ready", {}, signal);
        version.textContent = `LIPServe ${ready.version}`;
        const warningBanner = ready.checks.some((check) => check.state !== "ok");
        show(warningBanner ? "ready, with warnings" : "ready", warningBanner ? "warn" : "good", ready.checks);
        answered = new Date();
        since.textContent = "";
      } catch (error) {
        if (signal.aborted || error.name === "AbortError") return;
        if (error.status === 503 && error.detail?.length) {
          const failed = error.detail.map((item) => ({ name: item.field, state: "failed", message: item.value }));
          show("not ready", "bad", failed);
          answered = new Date();
          since.textContent = "";
        } else {
          show("no connection", "bad", [{ name: "service", state: "failed", message: error.message }]);
          since.textContent = answered ? `last response ${when(answered.toISOString())}` : "";
        }
      }
    },
    signal,
  );
}

function part({ name, state, message }) {
  return h("li", {}, badge(state), " ", h("strong", {}, name), " ", h("span", { class: "muted" }, String(message)));
}
