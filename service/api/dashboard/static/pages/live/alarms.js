// Alarms, and the decision after a change of the robot.

import { path, post } from "../../api.js";
import { h, refresh, replace } from "../../dom.js";
import { counted, sentence, when } from "../../format.js";
import { badge, button, confirm, field, notice } from "../../ui.js";

const CONFIRMATIONS = {
  adapt: "Choose this if the robot has a payload or a new tool. The model learns the change, and earlier data counts less.",
  ignore: "Choose this if the robot has not changed. If it has, learning damages the model.",
};

/** Show the alarms, and the decision while learning is paused by a change. */
export function alarms(page, status, name, signal) {
  const key = status.held ? String(status.held.at) : "";
  if ((page.decision.dataset.key ?? "") !== key) {
    page.decision.dataset.key = key;
    replace(page.decision, status.held ? decisionBanner(status, name, signal) : null);
  }
  refresh(page.alarms, status.alarms.length ? alarmList(status.alarms) : null);
}

const MARK_KINDS = { promotion: "good", payload: "good", change: "bad" };

/** Return the alarms of a stream as marks on the time axis, at their start if that is known. newest: time of the newest row, Unix s, the zero of the axis. */
export function alarmMarks(found, stream, newest) {
  const own = found.filter(({ evidence }) => (evidence.stream_id ?? stream) === stream);
  return own.map(({ at, kind, evidence }) => ({ x: (evidence.at ?? Date.parse(at) / 1000) - newest, word: kind, kind: MARK_KINDS[kind] ?? "warn" }));
}

function decisionBanner({ held, alarms }, name, signal) {
  const replay = h("input", { type: "checkbox" });
  const decide = (choice) => async () => {
    if (!(await confirm(CONFIRMATIONS[choice], choice === "adapt" ? "Adapt" : "Resume learning", choice === "adapt" ? "primary" : "danger"))) return;
    const done = await post(path`/v1/models/${name}/learning/change`, { decision: choice, replay: replay.checked }, signal);
    notice(`Learning has resumed${done.rows ? `, with ${counted(done.rows, "rejected row")}` : ""}.`);
  };
  const message = alarms.find((alarm) => alarm.kind === "change")?.message;
  return h(
    "section",
    { class: "banner", "aria-label": "Decision" },
    h("h2", {}, "Learning is paused"),
    h("p", {}, message ? `${sentence(message)} ` : "The robot may have changed. ", held.at === null ? null : `Start of the change: ${when(held.at)}. `, "Until you decide, the model serves its earlier state, and its torque may be wrong."),
    field("Also learn the rows rejected since then", replay),
    h("div", { class: "actions" }, button("Adapt to the change", decide("adapt"), { kind: "primary" }), button("No change, resume learning", decide("ignore"))),
  );
}

function alarmList(items) {
  return h(
    "section",
    { class: "card", "aria-label": "Alarms" },
    h("h2", {}, "Recent alarms"),
    h("ul", {}, items.map((alarm) => h("li", {}, badge(alarm.kind, { promotion: "good", payload: "plain" }[alarm.kind] ?? "warn"), ` ${when(alarm.at)}: ${alarm.message}`))),
  );
}
