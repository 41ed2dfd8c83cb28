// Status of learning, quality and answers, updated once per second.

import { Badge, Card, Facts, Table } from "../../components.js";
import { count, counted, number, percent, seconds, sentence, shortNames, torqueUnit } from "../../format.js";
import { html } from "../../preact.js";
import { codeLabel } from "./codes.js";
import { VerdictNote } from "../../verdicts.js";
import { Explanation } from "./explanation.js";

/** The state of learning and the counts of rows by code. */
export function Learning({ status }) {
  const [latest] = status.windows;
  const recent = { learnt: latest.accepted, ...latest.rejected };
  const codes = Object.keys(status.counts).filter((code) => !["batches", "duplicates"].includes(code) && (status.counts[code] || recent[code]));
  const [word, kind] = status.held ? ["paused by a change", "warn"] : status.learns ? ["enabled", "good"] : ["paused", "warn"];
  const columns = [
    { label: "Rows", cell: codeLabel },
    { label: `last ${span(latest.seconds)}`, numeric: true, cell: (code) => count(recent[code] ?? 0) },
    { label: "since service start", numeric: true, cell: (code) => count(status.counts[code]) },
  ];
  return html`
    <${Facts} pairs=${[
      ["Serving", `version ${status.version}, revision ${count(status.revision)}`],
      ["Pending", status.lag_rows ? `${counted(status.lag_rows, "row")}, ${seconds(status.lag_s)} behind` : "none"],
      ["Learning", html`<${Badge} state=${word} kind=${kind} />`],
      ["Outside the training data", status.novel_share === null ? "unknown" : `${percent(status.novel_share, 0)} of rows`],
    ]} />
    ${status.failure && html`<div class="banner bad">Learning failed. ${sentence(status.failure)} Retrying.</div>`}
    ${codes.length ? html`<${Table} columns=${columns} rows=${codes} caption="Rows by result" identity=${(code) => code} />` : html`<p class="muted">No rows since the service started.</p>`}`;
}

/** Errors and coverage of the last minute by joint. verdict: on the serving version, which knows the range of its torque; may be undefined. */
export function Quality({ status: { windows: [latest], joint_names: names, joint_types: types, level, scale, verdict: lately }, verdict }) {
  if (!latest.rows) return html`<${Card} title="Quality"><p class="muted">No measured torque in the last ${span(latest.seconds)}.</p><//>`;
  const short = shortNames(names);
  const share = (joint) => {
    const judged = verdict?.joints.find((each) => each.joint === names[joint]);
    return judged?.range_share ? percent((latest.rmse[joint] * judged.range_share) / judged.rmse) : "–";
  };
  const columns = [
    { label: "Joint", cell: (joint) => short[joint] },
    { label: "RMSE", term: "rmse", numeric: true, cell: (joint) => `${number(latest.rmse[joint], 2)}\u00a0${torqueUnit(types[joint])}` },
    { label: "of range", numeric: true, cell: share },
    { label: `${percent(level, 0)} coverage`, term: "coverage", numeric: true, cell: (joint) => percent(latest.coverage[joint]) },
    { label: "served", numeric: true, cell: (joint) => percent(latest.coverage_answered[joint]) },
    { label: "factor", numeric: true, cell: (joint) => `×\u00a0${number(scale[joint], 2)}` },
  ];
  return html`<${Card} title="Quality">
    <${VerdictNote} verdict=${lately} />
    <${Table} columns=${columns} rows=${names.map((_name, joint) => joint)} caption=${`${count(latest.rows)} rows of the last ${span(latest.seconds)}, predicted before they were learnt`} />
    <${Explanation}>Of range: RMSE as a share of the range of the torque in training. Coverage is that of the model’s own intervals, served that of the intervals in responses. These are scaled by the factor. It adapts to recent errors, also at rest and during contacts, so that coverage reaches ${percent(level, 0)}.<//>
  <//>`;
}

/** The latency of the answers since the last status; nothing if there were none. */
export function Answers({ answers }) {
  if (!answers?.count) return null;
  const within = (bound) => (bound === null ? "> 30 s" : `≤ ${seconds(bound)}`);
  const pairs = [
    ["Answers per second", count(answers.count / answers.seconds)],
    ["Median latency", within(answers.p50_at_most_s)],
    ["99th percentile", within(answers.p99_at_most_s)],
  ];
  if (answers.late) pairs.push(["Late", html`<${Badge} state=${`${count(answers.late)} late`} kind="warn" />`]);
  if (answers.refused) pairs.push(["Rejected", html`<${Badge} state=${`${count(answers.refused)} rejected`} kind="bad" />`]);
  return html`<section class="vitals" aria-label="Stream answers" title="All streams of this model in the last second; time in the service, without the network"><${Facts} pairs=${pairs} /></section>`;
}

function span(length) {
  return length === 60 ? "minute" : seconds(length);
}
