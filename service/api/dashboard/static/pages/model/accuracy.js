// How well a version predicts a recording: torque and residual with their bands, error by stretch, reliability, figures.

import { post } from "../../api.js";
import { h, replace } from "../../dom.js";
import { card, loading } from "../../ui.js";
import { boxes, figures, reliability } from "./figures.js";
import { noData } from "./choice.js";
import { verdicts } from "./coverage.js";
import { around, broken, column, measurementStd } from "./curves.js";
import { flattery } from "./flattery.js";
import { joints } from "./joints.js";

const POINTS = 1000;

/** The tab of a version's accuracy on the chosen recording. */
export async function accuracy(view, state, { signal }) {
  if (state.dataset === null) {
    replace(view, noData(state));
    return;
  }
  replace(view, loading("Asking the model along the recording"));
  const request = { dataset: state.dataset, version: state.version.version, part: state.part };
  const fetch = async (start, stop) => {
    const range = stop === null ? {} : { start, stop };
    const trace = await post(`${state.where}/trace`, { ...request, ...range, points: POINTS }, signal);
    return { ...trace, joint_types: state.version.joint_types };
  };
  const trace = await fetch(0, null);
  // the plot first: an evaluation asks for up to five times as many rows
  const evaluated = post(`${state.where}/evaluate`, request, signal);
  evaluated.catch(() => {}); // it is awaited below, unless drawing fails before
  const along = h("div", {}), table = h("div", {}), all = h("div", {}), spread = h("div", {}), reliable = h("div", {});
  replace(
    view,
    flattery(trace),
    table,
    card("Measured and predicted torque", along),
    all,
    h(
      "div",
      { class: "grid wide" },
      card("Error by stretch", spread),
      card("Reliability", reliable),
    ),
  );
  for (const place of [table, all, spread, reliable]) replace(place, loading("Evaluating"));
  await joints(along, {
    first: trace,
    fetch,
    signal,
    views: { "measured and predicted torque": torque, "residual, measured − predicted": residual },
    about: {
      "measured and predicted torque":
        "95 % of the measurements should lie in the band. It covers the model’s uncertainty and the sensors’ noise.",
      "residual, measured − predicted":
        "95 % of the residual should lie in the band. Where it stays on one side of zero, the model lacks something.",
    },
  });
  const evaluation = await evaluated;
  if (signal.aborted) return;
  replace(table, verdicts(evaluation));
  replace(all, figures(evaluation));
  await boxes(spread, evaluation, signal);
  await reliability(reliable, evaluation, signal);
}

function torque(trace, joint, x) {
  const mean = column(trace.mean, joint);
  return [
    around(x, mean, measurementStd(trace, joint), trace.breaks, "95 % band of measurements", "predicted"),
    broken(x, column(trace.tau, joint), trace.breaks, "measured", "measured", { line: { width: 3 }, opacity: 0.5 }),
    broken(x, mean, trace.breaks, "predicted", "predicted", { line: { width: 1.4 } }),
  ];
}

function residual(trace, joint, x) {
  const mean = column(trace.mean, joint);
  const error = column(trace.tau, joint).map((value, index) => value - mean[index]);
  const zero = mean.map(() => 0);
  return [
    around(x, zero, measurementStd(trace, joint), trace.breaks, "95 % band of measurements", "predicted"),
    broken(x, error, trace.breaks, "measured − predicted", "measured"),
  ];
}
