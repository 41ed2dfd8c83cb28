// Figures of an evaluation: a table per joint, nMSE by stretch as boxes, observed against promised coverage.

import { h, replace } from "../../dom.js";
import { count, counted, number, percent, scientific, shortNames } from "../../format.js";
import { line, plot } from "../../plots.js";
import { card, table } from "../../ui.js";

/** Figures of each joint. */
export function figures(evaluation) {
  const { joint_names: joints, coverages, stretches } = evaluation;
  const short = shortNames(joints);
  const used = evaluation.samples_used < evaluation.samples ? `${count(evaluation.samples_used)} evenly chosen of ${count(evaluation.samples)}` : `all ${count(evaluation.samples)}`;
  const numeric = (label, cell) => ({ label, cell, numeric: true });
  const columns = [
    { label: "Joint", cell: (joint) => short[joint] },
    numeric("nMSE", (joint) => scientific(evaluation.nmse[joint])),
    numeric("RMSE, N·m", (joint) => number(evaluation.rmse[joint])),
    ...coverages.map((each, level) => numeric(`in ${percent(each.level, 0)}`, (joint) => percent(coverages[level].coverage[joint]))),
    numeric("95 % width, N·m", (joint) => number(evaluation.interval_width[joint])),
    numeric("NLPD, nats", (joint) => number(evaluation.nlpd[joint])),
  ];
  return card(
    "All figures",
    evaluation.warnings.map((text) => h("div", { class: "banner", role: "note" }, `${text[0].toUpperCase()}${text.slice(1)}.`)),
    table(columns, joints.map((_name, joint) => joint), { caption: `On ${used} samples${stretches.kind === "episodes" ? `, ${counted(stretches.samples.length, "episode")}` : ""}` }),
    h("p", { class: "hint" }, "nMSE is the mean squared error / variance of the measured torque. 1 is no better than always answering the mean; a joint whose torque is mostly noise cannot come near 0. “In 95 %” is the share of measurements inside the 95 % band, and should be near 95 %."),
  );
}

/** nMSE of every stretch, a box a joint. */
export async function boxes(element, { joint_names: joints, stretches }, signal) {
  const place = h("div", {}), names = shortNames(joints);
  const what = stretches.kind === "episodes" ? counted(stretches.samples.length, "episode") : `${counted(stretches.samples.length, "equal stretch", "equal stretches")} of the recording`;
  replace(
    element,
    place,
    h("p", { class: "hint" }, `Each point is the nMSE of one of ${what}. A box holds the middle half, its line is the median. Points far up: motion that is predicted much worse.`),
  );
  const traces = stretches.nmse.map((values, joint) => ({
    type: "box", y: values, name: names[joint], colour: joint, boxpoints: "all", jitter: 0.5, pointpos: 0, marker: { size: 4, opacity: 0.7 }, hovertemplate: "%{y:.3g}",
  }));
  const layout = { y: "nMSE", height: 340, showlegend: false, hovermode: "closest", yaxis: { type: "log", exponentformat: "power", dtick: 1 } };
  await plot(place, traces, layout, { label: `nMSE of ${what}, joint by joint`, signal });
}

/** Observed against promised coverage, a line a joint. */
export async function reliability(element, { joint_names: joints, reliability: curve }, signal) {
  const place = h("div", {}), names = shortNames(joints);
  replace(
    element,
    place,
    h("p", { class: "hint" }, "How many measurements each band holds, against how many it should hold. The diagonal is right. Below it bands are too narrow: the model is too sure."),
  );
  const whole = { range: [0, 1], tickformat: ".0%", dtick: 0.2 };
  const traces = [
    line([0, 1], [0, 1], "true", "muted", { line: { dash: "dash", width: 1.5 }, hoverinfo: "skip" }),
    ...curve.observed.map((observed, joint) => line(curve.nominal, observed, names[joint], joint, { mode: "lines+markers", marker: { size: 4 }, hovertemplate: "%{y:.1%}" })),
  ];
  const layout = { x: "promised", y: "observed", height: 340, xaxis: whole, yaxis: whole, showlegend: true };
  await plot(place, traces, layout, { label: "Observed against promised coverage, joint by joint", signal });
}
