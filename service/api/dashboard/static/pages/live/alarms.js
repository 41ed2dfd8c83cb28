// What the model's owner should know, and the decision that learning waits for.

import { path, post } from "../../api.js";
import { h, refresh, replace } from "../../dom.js";
import { counted, when } from "../../format.js";
import { badge, button, confirm, field, notice } from "../../ui.js";

const WORDS = {
  adapt: "Choose this if the robot has a payload or a new tool: it is learnt anew, and what was learnt before counts less.",
  ignore: "Choose this if the robot is the same as before. If it has changed, going on ruins what the model knows.",
};

/** Show alarms, and buttons where learning is held; the buttons stay while they are needed. */
export function alarms(page, status, name, signal) {
  const key = status.held ? String(status.held.at) : "";
  if ((page.held.dataset.key ?? "") !== key) {
    page.held.dataset.key = key;
    replace(page.held, status.held ? decision(status, name, signal) : null);
  }
  refresh(page.alarms, status.alarms.length ? list(status.alarms) : null);
}

const MARKS = { promotion: "good", payload: "good", change: "bad" };

/** Alarms of a stream as marks of the plots' time axis, whose zero is the newest row's time, Unix seconds: where it began, by the rows' own clock, if that is known. */
export function alarmMarks(found, stream, newest) {
  const own = found.filter(({ evidence }) => (evidence.stream_id ?? stream) === stream);
  return own.map(({ at, kind, evidence }) => ({ x: (evidence.at ?? Date.parse(at) / 1000) - newest, word: kind, kind: MARKS[kind] ?? "warn" }));
}

function decision({ held, alarms }, name, signal) {
  const replay = h("input", { type: "checkbox" });
  const decide = (choice) => async () => {
    if (!(await confirm(WORDS[choice], choice === "adapt" ? "Adapt" : "Go on as before", choice === "adapt" ? "primary" : "danger"))) return;
    const done = await post(path`/v1/models/${name}/learning/change`, { decision: choice, replay: replay.checked }, signal);
    notice(`Learning goes on${done.rows ? `, with ${counted(done.rows, "row")} that had been kept out` : ""}.`);
  };
  const said = alarms.find((alarm) => alarm.kind === "change")?.message;
  return h(
    "section",
    { class: "banner", "aria-label": "Decision" },
    h("h2", {}, "Learning waits for you"),
    h("p", {}, said ? `${said[0].toUpperCase()}${said.slice(1)}. ` : "The robot seems to have changed. ", held.at === null ? null : `It began on ${when(held.at)}. `, "Until you decide, the model answers with what it knew before. Its torque may be wrong."),
    field("Also learn the rows kept out since", replay),
    h("div", { class: "actions" }, button("Adapt to the changed robot", decide("adapt"), { kind: "primary" }), button("Nothing has changed, go on", decide("ignore"))),
  );
}

function list(items) {
  return h(
    "section",
    { class: "card", "aria-label": "Alarms" },
    h("h2", {}, "Newest alarms"),
    h("ul", {}, items.map((alarm) => h("li", {}, badge(alarm.kind, { promotion: "good", payload: "plain" }[alarm.kind] ?? "warn"), ` ${when(alarm.at)}: ${alarm.message}`))),
  );
}
