// Summary of a data set's report: key figures and recommendations.

import { jointVar } from "../../colours.js";
import { Card, Facts } from "../../components.js";
import { count, counted, number, seconds, shortNames, when } from "../../format.js";
import { html } from "../../preact.js";
import { Prose } from "../../prose.js";

const CONVENTIONS = { gravity_included: "gravity included", gravity_compensated: "gravity compensated" };
const MAX_VISIBLE = 3; // recommendations that are visible at once

/** The recommendations, the most important first. */
export function Recommendations({ dataset: { report, joint_names: joints } }) {
  const [first, rest] = [report.advice.slice(0, MAX_VISIBLE), report.advice.slice(MAX_VISIBLE)];
  const list = (texts, start) => html`<ol class="advice" start=${start}>${texts.map((text) => html`<li key=${text}><${WithJoints} text=${text} joints=${joints} /></li>`)}</ol>`;
  return html`<${Card} title="Recommendations" kind=${first.length ? "todo" : "todo done"}>
    ${first.length ? list(first, 1) : html`<p>✓ None. The recording is good for training.</p>`}
    ${rest.length > 0 && html`<details><summary>${rest.length} more</summary>${list(rest, MAX_VISIBLE + 1)}</details>`}
  <//>`;
}

/** A sentence with the joints at its beginning in their colours. */
function WithJoints({ text, joints }) {
  const [, who, what] = /^([^:]+): (.*)$/s.exec(text) ?? [null, "", text];
  const named = who.split(/, | and /);
  if (!who || !named.every((each) => joints.includes(each))) return html`<${Prose} text=${text} />`;
  const names = shortNames(joints);
  const all = named.length === joints.length && joints.length > 1;
  const marks = named.map((each) => joints.indexOf(each)).map((index) => html`<span class="joint" key=${index} style=${`--own: ${jointVar(index)}`}>${names[index]}</span>`);
  return html`<span class="who">${all ? "All joints" : marks}</span> <${Prose} text=${what} />`;
}

/** The key figures in one line; the reader can open the rest. */
export function Summary({ dataset: { report, joint_names: joints, ...dataset } }) {
  const line = [
    `${counted(report.rows, "sample")} of ${counted(joints.length, "joint")}`,
    report.timing.duration_s === null ? null : seconds(report.timing.duration_s),
    report.rate_hz === null ? "rate unknown" : `${number(report.rate_hz, 4)}\u00a0Hz`,
    report.episodes === 1 ? null : counted(report.episodes, "episode"),
    CONVENTIONS[dataset.torque_convention] ?? dataset.torque_convention,
    report.robot,
  ];
  const pairs = [
    ["Rows uploaded", count(report.rows_uploaded)],
    ["Episodes", count(report.episodes)],
    ["Derived signals", report.derived.length ? report.derived.join(", ") : "none"],
    ["Robot", report.robot ?? "unspecified"],
    ["Uploaded", when(dataset.created_at)],
    ["ID", html`<code>${dataset.id}</code>`],
  ];
  return html`<details class="about">
    <summary>${line.filter(Boolean).join(" · ")}</summary>
    <${Facts} pairs=${pairs} />
    <p><span class="muted">Joints: </span>${joints.join(", ")}</p>
  </details>`;
}
