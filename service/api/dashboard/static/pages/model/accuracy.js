// Accuracy of a version on a recording: verdict, torque and residual with intervals, error by segment, reliability, figures.

import { post } from "../../api.js";
import { Await, Card, useRead } from "../../components.js";
import { JointVerdicts } from "../../jointverdicts.js";
import { html } from "../../preact.js";
import { VerdictNote } from "../../verdicts.js";
import { NoData } from "./choice.js";
import { column, intervalArea, intervalColumns, lineWithGaps, measurementStd } from "./curves.js";
import { AllFigures, Boxes, Reliability } from "./figures.js";
import { JointPlots } from "./joints.js";
import { TrainingDataNotes } from "./training_data.js";

const POINTS = 1000;
const VIEWS = { "measured and predicted torque": torque, "residual, measured − predicted": residual };
const ABOUT = {
  "measured and predicted torque": "95 % of the measurements should lie in the interval. It includes the uncertainty of the model and the noise of the sensors.",
  "residual, measured − predicted": "95 % of the residuals should lie in the interval. A residual that stays on one side of zero is a systematic error of the model.",
};

/** The tab for the selected recording. */
export function Accuracy({ where, version, datasets, dataset, part }) {
  const request = { dataset: dataset?.id, version: version.version, part };
  const fetch = (rows, signal) => post(`${where}/trace`, { ...request, ...rows, points: POINTS }, signal);
  const read = (ask) => useRead(async (signal) => dataset && ask(signal), [where, dataset?.id, version.version, part]);
  const trace = read((signal) => fetch({}, signal));
  const evaluation = read((signal) => post(`${where}/evaluate`, request, signal));
  if (!dataset) return html`<${NoData} version=${version} datasets=${datasets} />`;
  return html`
    ${evaluation.value && !evaluation.value.judged && html`<${Card} title="Verdict on this recording"><${VerdictNote} verdict=${evaluation.value.verdict} /><${JointVerdicts} verdict=${evaluation.value.verdict} /><//>`}
    <${Await} reading=${trace} what="Predicting the recording">${(first) => html`
      <${TrainingDataNotes} trace=${first} />
      <${Card} title="Measured and predicted torque"><${JointPlots} first=${first} fetch=${fetch} views=${VIEWS} about=${ABOUT} types=${version.joint_types} name=${`torque of ${version.model} ${version.version}`} numbers=${numbers} /><//>`}
    <//>
    <${Await} reading=${evaluation} what="Evaluating">${(found) => html`
      <div class="grid wide">
        <${Card} title="Reliability"><${Reliability} evaluation=${found} name=${`reliability of ${version.model} ${version.version}`} /><//>
        <${Card} title="Error by segment"><${Boxes} evaluation=${found} name=${`error by segment of ${version.model} ${version.version}`} /><//>
      </div>
      <${AllFigures} evaluation=${found} />`}
    <//>`;
}

function numbers(trace, joint) {
  return { measured: column(trace.tau, joint), ...intervalColumns("predicted", column(trace.mean, joint), measurementStd(trace, joint)) };
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
