// Alarms, and the decision after a change of the robot.

import { path, post } from "../../api.js";
import { Badge, Button, Card } from "../../components.js";
import { counted, sentence, when } from "../../format.js";
import { html, useState } from "../../preact.js";
import { confirm, notice } from "../../dialogs.js";

const FEW = 2;
const BADGES = { promotion: "good", payload: "plain" };
const CONFIRMATIONS = {
  adapt: "Choose this if the robot has a payload or a new tool. The model learns the change, and earlier data counts less.",
  ignore: "Choose this if the robot has not changed. If it has, learning damages the model.",
};

const MARK_KINDS = { promotion: "good", payload: "good", change: "bad" };

/** Return the alarms of a stream as marks on the time axis, at their start if that is known. newest: time of the newest row, Unix s, the zero of the axis. */
export function alarmMarks(found, stream, newest) {
  const own = found.filter(({ evidence }) => (evidence.stream_id ?? stream) === stream);
  return own.map(({ at, kind, evidence }) => ({ x: (evidence.at ?? Date.parse(at) / 1000) - newest, word: kind, kind: MARK_KINDS[kind] ?? "warn" }));
}

/** The decision while learning is paused by a change. */
export function Decision({ status: { held, alarms }, name, signal }) {
  const [replay, setReplay] = useState(false);
  const decide = (choice) => async () => {
    if (!(await confirm(CONFIRMATIONS[choice], choice === "adapt" ? "Adapt" : "Resume learning", choice === "adapt" ? "primary" : "danger"))) return;
    const done = await post(path`/v1/models/${name}/learning/change`, { decision: choice, replay }, signal);
    notice(`Learning has resumed${done.rows ? `, with ${counted(done.rows, "rejected row")}` : ""}.`);
  };
  const message = alarms.find((alarm) => alarm.kind === "change")?.message;
  return html`<section class="banner" aria-label="Decision">
    <h2>Learning is paused</h2>
    <p>${message ? sentence(message) : "The robot may have changed."} ${held.at !== null && `Start of the change: ${when(held.at)}. `}Until you decide, the model serves its earlier state, and its torque may be wrong.</p>
    <p><label><input type="checkbox" checked=${replay} onChange=${(event) => setReplay(event.target.checked)} /> Also learn the rows rejected since then</label></p>
    <div class="actions"><${Button} kind="primary" onclick=${decide("adapt")}>Adapt to the change<//><${Button} onclick=${decide("ignore")}>No change, resume learning<//></div>
  </section>`;
}

/** The latest alarms, and earlier ones on demand. */
export function Alarms({ alarms }) {
  const earlier = alarms.slice(FEW);
  return html`<${Card} title="Alarms">
    <${List} alarms=${alarms.slice(0, FEW)} />
    ${earlier.length > 0 && html`<details><summary>${counted(earlier.length, "earlier alarm")}</summary><${List} alarms=${earlier} /></details>`}
  <//>`;
}

function List({ alarms }) {
  return html`<ul class="rows">${alarms.map((alarm) => html`<li key=${alarm.id}><${Badge} state=${alarm.kind} kind=${BADGES[alarm.kind] ?? "warn"} /> ${when(alarm.at)}: ${alarm.message}</li>`)}</ul>`;
}
