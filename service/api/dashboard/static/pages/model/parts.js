// Components of the torque along a recording. No sensor measures them.

import { post } from "../../api.js";
import { Await, Card, useRead } from "../../components.js";
import { html } from "../../preact.js";
import { NoData } from "./choice.js";
import { componentColour, componentLabel, offered } from "./components.js";
import { column, intervalArea, intervalColumns, lineWithGaps } from "./curves.js";
import { JointPlots } from "./joints.js";
import { TrainingDataNotes } from "./training_data.js";

const POINTS = 500;
const NOTE = "No sensor measures these components. Their 95 % intervals are those of the model and cannot be verified.";

/** The tab for the selected recording. */
export function Components({ where, version, datasets, dataset, part }) {
  const names = offered(version);
  const request = { dataset: dataset?.id, version: version.version, part, points: POINTS, components: names };
  const fetch = (rows, signal) => post(`${where}/trace`, { ...request, ...rows }, signal);
  const trace = useRead(async (signal) => dataset && fetch({}, signal), [where, dataset?.id, version.version, part]);
  if (!dataset) return html`<${NoData} version=${version} datasets=${datasets} />`;
  const all = names.length > 1 ? { "all components": (...given) => names.flatMap((name) => component(name, ...given)) } : {};
  const views = { ...all, ...Object.fromEntries(names.map((name) => [componentLabel(name), (...given) => component(name, ...given)])) };
  const about = Object.fromEntries(Object.keys(views).map((view) => [view, `${NOTE}${names.length > 1 ? " Their sum is the predicted torque." : ""}`]));
  const numbers = ({ components }, joint) => Object.assign({}, ...names.map((name) => intervalColumns(componentLabel(name), column(components[name].mean, joint), column(components[name].std, joint))));
  return html`<${Await} reading=${trace} what="Computing the components">${(first) => html`
    <${TrainingDataNotes} trace=${first} />
    <${Card} title="Torque components">
      ${names.length === 1 && html`<p class="hint">The estimator ${version.estimator} only separates friction from the rest. For gravity, inertial and Coriolis torques, train rigid-body or lip-chain.</p>`}
      <${JointPlots} first=${first} fetch=${fetch} views=${views} about=${about} types=${version.joint_types} name=${`components of ${version.model} ${version.version}`} numbers=${numbers} />
    <//>`}
  <//>`;
}

function component(name, trace, joint, x) {
  const values = trace.components[name], mean = column(values.mean, joint), colour = componentColour(name);
  return [
    intervalArea(x, mean, column(values.std, joint), trace.breaks, `${componentLabel(name)}, 95 % interval`, colour, { showlegend: false }),
    lineWithGaps(x, mean, trace.breaks, componentLabel(name), colour),
  ];
}
