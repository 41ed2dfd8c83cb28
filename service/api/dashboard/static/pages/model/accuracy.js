// Accuracy of a version on a recording: torque and residual with intervals, error by segment, reliability, figures.

import { post } from "../../api.js";
import { h, replace } from "../../dom.js";
import { card, loading } from "../../ui.js";
import { boxes, figures, reliability } from "./figures.js";
import { noData } from "./choice.js";
import { verdictCard } from "./coverage.js";
import { intervalArea, lineWithGaps, column, measurementStd } from "./curves.js";
import { trainingDataNotes } from "./training_data.js";
import { jointPlots } from "./joints.js";

const POINTS = 1000;

/** Draw the tab for the selected recording. */
export async function accuracy(view, state, { signal }) {
  if (state.dataset === null) {
    replace(view, noData(state));
    return;
  }
  replace(view, loading("Predicting the recording"));
  const request = { dataset: state.dataset, version: state.version.version, part: state.part };
  const fetch = async (start, stop) => {
    const range = stop === null ? {} : { start, stop };
    const trace = await post(`${state.where}/trace`, { ...request, ...range, points: POINTS }, signal);
    return { ...trace, joint_types: state.version.joint_types };
  };
  const trace = await fetch(0, null);
  // draw the plot first: an evaluation predicts up to five times as many rows
  const evaluated = post(`${state.where}/evaluate`, request, signal);
  evaluated.catch(() => {}); // awaited below unless drawing fails
  const along = h("div", {}), table = h("div", {}), all = h("div", {}), spread = h("div", {}), reliable = h("div", {});
  replace(
    view,
    trainingDataNotes(trace),
    table,
    card("Measured and predicted torque", along),
    all,
    h(
      "div",
      { class: "grid wide" },
      card("Error by segment", spread),
      card("Reliability", reliable),
    ),
  );
  for (const place of [table, all, spread, reliable]) replace(place, loading("Evaluating"));
  await jointPlots(along, {
    first: trace,
    fetch,
    signal,
    views: { "measured and predicted torque": torque, "residual, measured − predicted": residual },
    about: {
      "measured and predicted torque":
        "95 % of the measurements should lie in the interval. It includes the uncertainty of the model and the noise of the sensors.",
      "residual, measured − predicted":
        "95 % of the residuals should lie in the interval. A residual that stays on one side of zero is a systematic error of the model.",
    },
  });
  const evaluation = await evaluated;
  if (signal.aborted) return;
  replace(table, verdictCard(evaluation));
  replace(all, figures(evaluation));
  await boxes(spread, evaluation, signal);
  await reliability(reliable, evaluation, signal);
}

function torque(trace, joint, x) {
  const mean = column(trace.mean, joint);
  return [
    intervalArea(x, mean, measurementStd(trace, joint), trace.breaks, "95 % interval of measurements", "predicted"),
    lineWithGaps(x, column(trace.tau, joint), trace.breaks, "measured", "measured", { line: { width: 3 }, opacity: 0.5 }),
    lineWithGaps(x, mean, trace.breaks, "predicted", "predicted", { line: { width: 1.4 } }),
  ];
}

function residual(trace, joint, x) {
  const mean = column(trace.mean, joint);
  const error = column(trace.tau, joint).map((value, index) => value - mean[index]);
  const zero = mean.map(() => 0);
  return [
    intervalArea(x, zero, measurementStd(trace, joint), trace.breaks, "95 % interval of measurements", "predicted"),
    lineWithGaps(x, error, trace.breaks, "measured − predicted", "measured"),
  ];
}
