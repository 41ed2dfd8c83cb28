// Figures of an evaluation: table by joint, nMSE by segment, reliability curve.

import { h, replace } from "../../dom.js";
import { count, counted, number, percent, scientific, sentence, shortNames } from "../../format.js";
import { line, plot } from "../../plots.js";
import { card, table } from "../../ui.js";

/** Return a card with the figures of each joint. */
export function figures(evaluation) {
  const { joint_names: joints, coverages, stretches } = evaluation;
  const short = shortNames(joints);
  const used = evaluation.samples_used < evaluation.samples ? `${count(evaluation.samples_used)} evenly spaced of ${count(evaluation.samples)}` : `all ${count(evaluation.samples)}`;
  const numeric = (label, cell) => ({ label, cell, numeric: true });
  const columns = [
    { label: "Joint", cell: (joint) => short[joint] },
    numeric("nMSE", (joint) => scientific(evaluation.nmse[joint])),
    numeric("RMSE, N·m", (joint) => number(evaluation.rmse[joint])),
    ...coverages.map((each, level) => numeric(`${percent(each.level, 0)} coverage`, (joint) => percent(coverages[level].coverage[joint]))),
    numeric("95 % interval width, N·m", (joint) => number(evaluation.interval_width[joint])),
    numeric("NLPD, nats", (joint) => number(evaluation.nlpd[joint])),
  ];
  return card(
    "All figures",
    evaluation.warnings.map((text) => h("div", { class: "banner", role: "note" }, sentence(text))),
    table(columns, joints.map((_name, joint) => joint), { caption: `On ${used} samples${stretches.kind === "episodes" ? `, ${counted(stretches.samples.length, "episode")}` : ""}` }),
    h("p", { class: "hint" }, "nMSE: mean squared error / variance of the measured torque. 1 is no better than the mean torque; if the torque is mostly noise, nMSE cannot be near 0. 95 % coverage: share of the measurements inside the 95 % interval; it should be near 95 %."),
  );
}

/** Plot the nMSE of every segment, a box for each joint. */
export async function boxes(element, { joint_names: joints, stretches }, signal) {
  const place = h("div", {}), names = shortNames(joints);
  const what = stretches.kind === "episodes" ? counted(stretches.samples.length, "episode") : `${counted(stretches.samples.length, "equal segment")} of the recording`;
  replace(
    element,
    place,
    h("p", { class: "hint" }, `Each point is the nMSE of one of ${what}. A box contains the middle half; its line is the median. High points: motion with much worse predictions.`),
  );
  const traces = stretches.nmse.map((values, joint) => ({
    type: "box", y: values, name: names[joint], colour: joint, boxpoints: "all", jitter: 0.5, pointpos: 0, marker: { size: 4, opacity: 0.7 }, hovertemplate: "%{y:.3g}",
  }));
  const layout = { y: "nMSE", height: 340, showlegend: false, hovermode: "closest", yaxis: { type: "log", exponentformat: "power", dtick: 1 } };
  await plot(place, traces, layout, { label: `nMSE of ${what}, by joint`, signal });
}

/** Plot the observed coverage over the nominal one, a line for each joint. */
export async function reliability(element, { joint_names: joints, reliability: curve }, signal) {
  const place = h("div", {}), names = shortNames(joints);
  replace(
    element,
    place,
    h("p", { class: "hint" }, "Observed coverage over nominal coverage. The diagonal is ideal. Below it, the intervals are too narrow: the model is overconfident."),
  );
  const whole = { range: [0, 1], tickformat: ".0%", dtick: 0.2 };
  const traces = [
    line([0, 1], [0, 1], "ideal", "muted", { line: { dash: "dash", width: 1.5 }, hoverinfo: "skip" }),
    ...curve.observed.map((observed, joint) => line(curve.nominal, observed, names[joint], joint, { mode: "lines+markers", marker: { size: 4 }, hovertemplate: "%{y:.1%}" })),
  ];
  const layout = { x: "nominal", y: "observed", height: 340, xaxis: whole, yaxis: whole, showlegend: true };
  await plot(place, traces, layout, { label: "Observed over nominal coverage, by joint", signal });
}
