// Comparison of versions on one recording: figures, verdict, and their torques in one plot.

import { post } from "../../api.js";
import { Await, Badge, Button, Card, Choice, Table, useRead } from "../../components.js";
import { count, counted, nmse, number, percent, sentence, shortNames } from "../../format.js";
import { Joint, JointColumns } from "../../jointbars.js";
import { html, useState } from "../../preact.js";
import { VerdictBadge } from "../../verdicts.js";
import { compatible, NoData, trainingRole } from "./choice.js";
import { column, lineWithGaps } from "./curves.js";
import { JointPlots } from "./joints.js";

const BADGE_KINDS = { no_difference: "plain", cannot_tell: "warn" };
const MAX_VERSIONS = 4, POINTS = 1000;
const DASHES = ["solid", "dash", "dot", "dashdot"];
const LEAST_NMSE = 1e-6, LEAST_COVERAGE = 0.8, NOMINAL = 0.95, LOW = 0.04; // bottoms of the bars, nominal coverage, height of the lowest bar
const ABOUT = { "residuals, measured − predicted": "Values nearer to zero are better.", "measured and predicted torque": "The versions differ where their lines differ." };

/** Choice of versions and of a recording, then their comparison. */
export function Compare(state) {
  const { model, version, datasets, dataset } = state;
  const offered = compatible(version, datasets), newest = [...model.versions].reverse();
  const [chosen, setChosen] = useState(() => [model.serving_version ?? model.versions[0].version, newest.find((each) => each.version !== model.serving_version).version]);
  const [recording, setRecording] = useState(dataset?.id), [asked, setAsked] = useState(null);
  if (!offered.length) return html`<${NoData} version=${version} datasets=${datasets} />`;
  const toggle = (number) => setChosen(chosen.includes(number) ? chosen.filter((each) => each !== number) : [...chosen, number]);
  const full = chosen.length >= MAX_VERSIONS, few = chosen.length < 2;
  const box = ({ version: number, estimator }) => html`<label key=${number}>
    <input type="checkbox" name="versions" value=${number} checked=${chosen.includes(number)} disabled=${full && !chosen.includes(number)} onChange=${() => toggle(number)} /> ${number}, ${estimator}${number === model.serving_version ? ", serving" : ""}
  </label>`;
  const role = (each) => trainingRole(version, each);
  return html`
    <fieldset class="choices"><legend>Versions</legend>
      ${newest.map(box)}<p class="hint" role="status">${few ? "Select at least two versions." : full ? `Max ${MAX_VERSIONS} versions.` : ""}</p>
    </fieldset>
    <${Choice} label="Recording" options=${offered.map((each) => [each.id, `${each.name || each.id}${role(each) ? `, ${role(each)}` : ""}`])} value=${recording} onchange=${setRecording} />
    <p><${Button} kind="primary" disabled=${few} onclick=${() => setAsked({ versions: chosen, dataset: recording, turn: (asked?.turn ?? 0) + 1 })}>Compare<//></p>
    ${asked && html`<${Result} key=${asked.turn} ...${state} ...${asked} />`}`;
}

function Result({ model, where, version, dataset, versions }) {
  const reference = versions.includes(model.serving_version) ? model.serving_version : versions[0];
  const order = [reference, ...versions.filter((each) => each !== reference)];
  const fetch = async (rows, signal) => {
    const traces = await Promise.all(order.map((each) => post(`${where}/trace`, { dataset, version: each, part: "all", points: POINTS, ...rows }, signal)));
    return { ...traces[0], means: traces.map((each) => each.mean) };
  };
  const compared = useRead((signal) => Promise.all(order.slice(1).map((each) => post(`${where}/compare`, { dataset, versions: [reference, each] }, signal))), []);
  const trace = useRead((signal) => fetch({}, signal), []);
  const line = (x, y, breaks, index) => lineWithGaps(x, y, breaks, `version ${order[index]}`, `version-${index + 1}`, { line: { width: 1.5, dash: DASHES[index] } });
  const views = {
    "residuals, measured − predicted": ({ tau, means, breaks }, joint, x) => means.map((rows, index) => line(x, rows.map((row, at) => tau[at][joint] - row[joint]), breaks, index)),
    "measured and predicted torque": ({ tau, means, breaks }, joint, x) => [
      lineWithGaps(x, column(tau, joint), breaks, "measured", "measured", { line: { width: 3 }, opacity: 0.4 }),
      ...means.map((rows, index) => line(x, column(rows, joint), breaks, index)),
    ],
  };
  const numbers = ({ tau, means }, joint) => ({ measured: column(tau, joint), ...Object.fromEntries(means.map((rows, index) => [`version ${order[index]}`, column(rows, joint)])) });
  return html`
    <div aria-live="polite"><${Await} reading=${compared} what="Comparing">${(found) => html`
      <${Figures} comparisons=${found} />
      ${found.length === 1 ? found[0].warnings.map((text) => html`<p class="banner" role="note">Biased comparison. ${sentence(text)}</p>`) : null}
      ${found.map((each) => html`<${Outcome} key=${each.versions[1].version} comparison=${each} />${found.length === 1
        ? html`<${ByJoint} comparison=${each} />`
        : html`<details><summary>Version ${each.versions[1].version} compared with ${each.versions[0].version}, by joint</summary><${ByJoint} comparison=${each} /></details>`}`)}`}
    <//></div>
    <${Card} title="Torques along the recording"><${Await} reading=${trace} what="Predicting the recording">${(first) => html`<${JointPlots} first=${first} fetch=${fetch} views=${views} about=${ABOUT} types=${version.joint_types} name=${`versions ${order.join(", ")} of ${model.name}`} numbers=${numbers} />`}<//><//>`;
}

/** A table with a row for the reference, which is part of every comparison, and for each other version. */
function Figures({ comparisons }) {
  const names = shortNames(comparisons[0].joint_names);
  const rows = [comparisons[0].versions[0], ...comparisons.map((each) => each.versions[1])];
  const figure = (text, bars) => html`<div class="figure"><span>${text}</span>${bars}</div>`;
  const error = ({ nmse: values }) => {
    const span = (value) => (value === null ? null : [0, Math.min(Math.max(1 - Math.log10(value) / Math.log10(LEAST_NMSE), LOW), 1)]);
    return figure(nmse(mean(values)), html`<${JointColumns} names=${names} spans=${values.map(span)} texts=${values.map(nmse)} what="nMSE" />`);
  };
  const coverage = ({ coverage: values }) => {
    const at = (value) => Math.min(Math.max((value - LEAST_COVERAGE) / (1 - LEAST_COVERAGE), 0), 1), due = at(NOMINAL);
    const span = (value) => [Math.min(at(value), due - LOW / 2), Math.max(at(value), due + LOW / 2)];
    return figure(percent(mean(values), 0), html`<${JointColumns} names=${names} spans=${values.map(span)} texts=${values.map((each) => percent(each))} what="Coverage of the 95 % interval" nominal=${due} />`);
  };
  const label = (row) => html`<i class="swatch" style=${`background: var(--version-${rows.indexOf(row) + 1})`}></i> ${row.version}${row.in_training && html`<span class="hint"> trained on this recording: optimistic</span>`}`;
  const columns = [
    { label: "Version", cell: label },
    { label: "Verdict", cell: (row) => html`<${VerdictBadge} verdict=${row.verdict} />` },
    { label: "nMSE", cell: error },
    { label: "95\u00a0% coverage", cell: coverage },
    { label: "NLPD, nats", numeric: true, cell: (row) => number(mean(row.nlpd)) },
  ];
  return html`<${Table} columns=${columns} rows=${rows} caption=${`Means over the joints on ${count(comparisons[0].samples_used)} of ${counted(comparisons[0].samples, "sample")}; bars show each joint`} />`;
}

function Outcome({ comparison: { better, outcome, verdict } }) {
  const label = better === null ? outcome.replace("_", " ") : `version ${better} is better`;
  return html`<p><${Badge} state=${label} kind=${BADGE_KINDS[outcome] ?? "good"} /> ${verdict}</p>`;
}

function ByJoint({ comparison }) {
  const [one, two] = comparison.versions, short = shortNames(comparison.joint_names);
  const { difference: by, half_width: half } = comparison.differences.nlpd;
  const numeric = (heading, cell) => ({ label: heading, numeric: true, cell });
  const columns = [
    { label: "Joint", cell: (joint) => html`<${Joint} index=${joint} name=${short[joint]} />` },
    numeric(`nMSE, v${one.version}`, (joint) => nmse(one.nmse[joint])),
    numeric(`nMSE, v${two.version}`, (joint) => nmse(two.nmse[joint])),
    numeric(`95\u00a0% coverage, v${one.version}`, (joint) => percent(one.coverage[joint])),
    numeric(`95\u00a0% coverage, v${two.version}`, (joint) => percent(two.coverage[joint])),
    numeric(`NLPD, v${two.version} − v${one.version}`, (joint) => `${number(by[joint])}${half[joint] === null ? "" : ` ± ${number(half[joint], 2)}`}`),
  ];
  return html`
    <${Table} columns=${columns} rows=${short.map((_name, joint) => joint)} caption=${`${count(comparison.samples_used)} of ${count(comparison.samples)} samples in ${counted(comparison.blocks, "block")}; ±: half-width of the 95\u00a0% interval`} />
    <p class="hint">NLPD, the negative log predictive density, is low if errors are small and intervals are correct. If the difference is below zero, version ${two.version} is better.</p>`;
}

/** Return the mean of the known values; null if there are none. */
function mean(values) {
  const known = values.filter((each) => each !== null);
  return known.length ? known.reduce((sum, each) => sum + each, 0) / known.length : null;
}
