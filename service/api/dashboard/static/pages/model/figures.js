// Figures of an evaluation: table by joint, nMSE by segment, reliability curve.

import { Card, Table, Term } from "../../components.js";
import { Export } from "../../exporting.js";
import { count, counted, number, percent, scientific, sentence, shortNames } from "../../format.js";
import { Joint, JointKey } from "../../jointbars.js";
import { Plot } from "../../plotted.js";
import { line } from "../../plots.js";
import { html } from "../../preact.js";

const HEIGHT = 300, MARGIN = { l: 56, r: 8, t: 8, b: 44 };

/** A card with the figures of each joint. */
export function AllFigures({ evaluation }) {
  const { joint_names: joints, coverages, stretches, warnings, samples, samples_used: taken } = evaluation;
  const short = shortNames(joints);
  const used = taken < samples ? `${count(taken)} evenly spaced of ${count(samples)}` : `all ${count(samples)}`;
  const numeric = (label, cell) => ({ label, cell, numeric: true });
  const columns = [
    { label: "Joint", cell: (joint) => html`<${Joint} index=${joint} name=${short[joint]} />` },
    numeric("nMSE", (joint) => scientific(evaluation.nmse[joint])),
    numeric("RMSE, N·m", (joint) => number(evaluation.rmse[joint])),
    ...coverages.map((each, level) => numeric(`${percent(each.level, 0)} coverage`, (joint) => percent(coverages[level].coverage[joint]))),
    numeric("95 % interval width, N·m", (joint) => number(evaluation.interval_width[joint])),
    numeric("NLPD, nats", (joint) => number(evaluation.nlpd[joint])),
  ];
  return html`<${Card} title="All figures">
    ${warnings.map((text) => html`<p class="banner" role="note">${sentence(text)}</p>`)}
    <${Table} columns=${columns} rows=${joints.map((_name, joint) => joint)} caption=${`On ${used} samples${stretches.kind === "episodes" ? `, ${counted(stretches.samples.length, "episode")}` : ""}`} />
    <p class="hint"><${Term} of="nmse">nMSE<//>: if the torque is mostly noise, nMSE cannot be near 0.</p>
  <//>`;
}

/** The nMSE of every segment, a box for each joint. name: of exported files. */
export function Boxes({ evaluation: { joint_names: joints, stretches }, name }) {
  const names = shortNames(joints);
  const what = stretches.kind === "episodes" ? counted(stretches.samples.length, "episode") : `${counted(stretches.samples.length, "equal segment")} of the recording`;
  const known = stretches.nmse.flat().filter((value) => value > 0);
  const decades = Math.max(...known) > 10 * Math.min(...known) ? { dtick: 1 } : {}; // a tick at each, if there are several
  const draw = () => [
    stretches.nmse.map((values, joint) => ({
      type: "box", y: values, name: names[joint], colour: joint, boxpoints: "all", jitter: 0.5, pointpos: 0, marker: { size: 4, opacity: 0.7 }, hovertemplate: "%{y:.3g}",
    })),
    { y: "nMSE", height: HEIGHT, margin: { ...MARGIN, b: 16 }, showlegend: false, hovermode: "closest", xaxis: { showticklabels: false }, yaxis: { type: "log", exponentformat: "power", ...decades } },
  ];
  return html`
    <p class="hint">Each point is the nMSE of one of ${what}. A box contains the middle half; its line is the median. High points: motion with much worse predictions.</p>
    <${Plot} draw=${draw} inputs=${[stretches]} label=${`nMSE of ${what}, by joint`} /><${JointKey} names=${names} />
    <${Export} name=${name} table=${() => [["joint", "segment", "samples", "nMSE"], ...joints.flatMap((joint, at) => stretches.nmse[at].map((value, index) => [joint, index + 1, stretches.samples[index], value]))]} />`;
}

/** The observed coverage over the nominal one, a line for each joint. name: of exported files. */
export function Reliability({ evaluation: { joint_names: joints, reliability: curve }, name }) {
  const names = shortNames(joints), whole = { range: [0, 1], tickformat: ".0%", dtick: 0.25 };
  const draw = () => [
    [
      line([0, 1], [0, 1], "ideal", "muted", { line: { dash: "dash", width: 1.5 }, hoverinfo: "skip" }),
      ...curve.observed.map((observed, joint) => line(curve.nominal, observed, names[joint], joint, { mode: "lines+markers", marker: { size: 4 }, hovertemplate: "%{y:.1%}" })),
    ],
    { x: "nominal coverage", y: "observed coverage", height: HEIGHT, margin: MARGIN, xaxis: whole, yaxis: whole, showlegend: false },
  ];
  return html`
    <p class="hint">The dashed diagonal is ideal. Below it, the intervals are too narrow: the model is overconfident. Above it, they are too wide.</p>
    <${Plot} draw=${draw} inputs=${[curve]} label="Observed over nominal coverage, by joint" /><${JointKey} names=${names} />
    <${Export} name=${name} table=${() => [["joint", "nominal coverage", "observed coverage"], ...joints.flatMap((joint, at) => curve.nominal.map((value, index) => [joint, value, curve.observed[at][index]]))]} />`;
}
