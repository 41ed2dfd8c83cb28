// The verdict on a version as components: badge, note, columns of lists.

import { Badge, Term } from "./components.js";
import { percent } from "./format.js";
import { html } from "./preact.js";
import { Prose } from "./prose.js";

const KINDS = { usable: "good", usable_in_range: "good", too_uncertain: "warn", wrong: "bad", not_judged: "plain" };

/** Return the level of a verdict as text and kind of a badge. */
export function verdictState({ level, label }) {
  return [label, KINDS[level]];
}

/** A badge with the level of a verdict. */
export function VerdictBadge({ verdict }) {
  const [state, kind] = verdictState(verdict);
  return html`<${Badge} state=${state} kind=${kind} title=${verdict.reason} />`;
}

/** A badge with the level of a joint. */
export function JointBadge({ joint: { level } }) {
  return html`<${Badge} state=${level.replaceAll("_", " ")} kind=${KINDS[level]} />`;
}

/** A note with the level of a verdict, why, and what to do. about: text before the level. */
export function VerdictNote({ verdict, about = "" }) {
  return html`<p class=${verdict.serves ? "verdict" : "verdict banner"} role="note">${about} <${VerdictBadge} verdict=${verdict} /> <${Prose} text=${verdict.reason} /> <span class="muted">${verdict.action}</span></p>`;
}

/** Explanation of the columns, shown below a list. */
export function VerdictHint() {
  return html`<p class="hint"><${Term} of="verdict">Verdict<//>: whether the torque can be used. Error: the largest <${Term} of="rmse">RMSE<//> of a joint, as a share of the range of its torque. 95\u00a0% <${Term} of="coverage">coverage<//>: the smallest of the joints. All are evaluated on <${Term} of="held-out">held-out<//> rows, before the version is trained on all rows.</p>`;
}

/** Columns of a list. of(row): the verdict of the row's version; null without a version. */
export function verdictColumns(of) {
  const figure = (name, choose) => (row) => {
    const known = (of(row)?.joints ?? []).map((each) => each[name]).filter((each) => each !== null);
    return known.length ? choose(...known) : null;
  };
  const error = figure("range_share", Math.max), coverage = figure("coverage", Math.min);
  const why = (verdict) => html`<details class="why"><summary><${VerdictBadge} verdict=${verdict} /></summary><p class="hint"><${Prose} text=${verdict.reason} /> ${verdict.action}</p></details>`;
  return [
    { label: "Verdict", value: (row) => of(row)?.label ?? null, cell: (row) => (of(row) ? why(of(row)) : "–") },
    { label: "Error", numeric: true, value: error, cell: (row) => percent(error(row), 1) },
    { label: "95\u00a0% coverage", numeric: true, value: coverage, cell: (row) => percent(coverage(row), 0) },
  ];
}
