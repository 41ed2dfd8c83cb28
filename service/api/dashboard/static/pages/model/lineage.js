// Lineage of a version: data, held-out part, options, fit, software.

import { Badge, Card, Facts, Link, Table, Term } from "../../components.js";
import { bytes, count, number, percent, scientific, seconds, shortNames, when } from "../../format.js";
import { Joint } from "../../jointbars.js";
import { html } from "../../preact.js";
import { LearningCurve } from "../../learning_curve.js";
import { SelectionCard } from "../../selection.js";
import { heldOut, HELD_OUT_NOTE } from "../job/words.js";

/** The tab. */
export function Lineage({ version, datasets }) {
  const { lineage: from, fit, compact, calibration, robot } = version;
  const options = Object.entries({ ...version.options, ...from.software }).map(([name, value]) => [name.replaceAll("_", " "), String(value).replace(/^([0-9a-f]{12})[0-9a-f]{28}/, "$1")]); // shorten commits
  return html`
    <${Card} title=${`Version ${version.version}`}><${Facts} pairs=${origin(version)} /><//>
    <${SelectionCard} version=${version} />
    <${LearningCurve} version=${version} />
    <${TrainedOn} from=${from} datasets=${datasets} />
    <${Figures} version=${version} />
    <${Card} title="Fit">
      <${Facts} pairs=${fitFacts(version)} />
      ${fit.converged === false && html`<p class="banner">The fit did not converge. More iterations may improve the model.</p>`}
    <//>
    <${Range} version=${version} />
    <${Card} title="Options and software"><${Facts} pairs=${options} /><//>
    <details><summary>Lineage as JSON</summary><pre tabindex="0"><code>${JSON.stringify({ lineage: from, fit, compact, calibration, robot: robot && { ...robot, urdf: undefined } }, null, 2)}</code></pre></details>`;
}

function origin(version) {
  const from = version.lineage;
  const found = [
    ["Model", version.model],
    ["Created", when(version.created_at)],
    ["Source", version.job ? html`<${Link} to=${`#/jobs/${version.job}`}>a training job<//>` : from.imported ? "import" : "shipped with LIPServe"],
    ["Estimator", version.estimator],
    ["Joints", version.joint_names.length < 3 ? version.joint_names.join(", ") : `${version.joint_names.length}, ${version.joint_names[0]} to ${version.joint_names.at(-1)}`],
    ["Torque", version.torque_convention.replace("_", " ")],
    ["Measurement noise, N·m", version.noise_std.map((each) => number(each, 2)).join(", ")],
  ];
  if (version.robot?.name) found.push(["Robot", version.robot.name]);
  if (from.base) found.push(["Transferred from", `${from.base.model} version ${from.base.version}`]);
  if (from.refresh) found.push(["Retrained from", `version ${from.refresh.version}`]);
  if (from.log) found.push(["Rows from the log", `${count(from.log.rows)} of ${count(from.log.found)}`]);
  if (from.made_by) found.push(["Created with", from.made_by]);
  return found;
}

function TrainedOn({ from, datasets }) {
  if (!from.datasets?.length) {
    const source = from.simulation ? "Simulated motion, trained on another machine." : from.imported ? "Imported. The archive names no data set." : "No data set is recorded.";
    return html`<${Card} title="Trained on"><p>${source}</p><//>`;
  }
  const known = new Set(datasets.map((each) => each.id));
  const held = (row) => from.holdout?.datasets.find((each) => each.id === row.id);
  const columns = [
    { label: "Data set", cell: (row) => (known.has(row.id) ? html`<${Link} to=${`#/data/${row.id}`}>${row.name || row.id}<//>` : `${row.name || row.id} (deleted)`) },
    { label: "Samples", numeric: true, cell: (row) => count(row.rows) },
    { label: "Held out", term: "held-out", numeric: true, cell: (row) => (held(row) ? `${count(held(row).rows)}${held(row).whole ? " (all)" : ""}` : "–") },
    { label: "Guard (unused)", numeric: true, cell: (row) => (held(row) ? count(held(row).guarded) : "–") },
    { label: "SHA-256", cell: (row) => html`<code title=${row.sha256}>${row.sha256?.slice(0, 12) ?? "–"}</code>` },
  ];
  return html`<${Card} title="Trained on"><${Table} columns=${columns} rows=${from.datasets} /><//>`;
}

function Figures({ version }) {
  const from = version.lineage;
  const sets = [
    ["Held out", from.holdout?.nmse ? from.holdout : null],
    ["Training data", from.training_metrics],
  ].filter(([, figures]) => figures);
  if (!sets.length) return null;
  const short = shortNames(version.joint_names);
  const columns = [
    { label: "Joint", cell: (joint) => html`<${Joint} index=${joint} name=${short[joint]} />` },
    ...sets.flatMap(([label, figures]) => [
      { label: `${label}: nMSE`, numeric: true, cell: (joint) => scientific(figures.nmse[joint]) },
      { label: "RMSE, N·m", numeric: true, cell: (joint) => number(figures.rmse[joint]) },
      { label: "95 % coverage", numeric: true, cell: (joint) => percent(figures.coverage[joint]) },
    ]),
  ];
  const caption = sets.map(([label, figures]) => `${label.toLowerCase()}: ${count(figures.samples)} of ${count(figures.of)} samples`).join("; ");
  const note = from.holdout ? `Held out: ${heldOut(from.holdout.split)}. ${from.holdout.learnt ? HELD_OUT_NOTE : ""}` : "Nothing was held out. Evaluate the version on a recording that it was not trained on.";
  return html`<${Card} title="Accuracy after training"><${Table} columns=${columns} rows=${short.map((_name, joint) => joint)} caption=${caption} /><p class="hint">${note}</p><//>`;
}

/** Labels of the fit's entries that end with the number of a joint. */
const OF_JOINTS = { right_angle_: "Probability that the axis is at right angles", local_: "Error after the local correction", widened_: "Intervals widened on held-out data", zero_: "Zero positions, ° (mm)" };

function fitFacts({ fit: report, compact, calibration, conformal, lineage: from }) {
  const found = [
    ["Converged", html`<${Badge} state=${report.converged ? "yes" : "no"} kind=${report.converged ? "good" : "warn"} />`],
    ["Iterations", count(report.iterations)],
    ["Duration", seconds(report.seconds)],
    ["Samples", count(report.samples_given)],
    ["Samples for the hyperparameters", count(report.samples_hyperparameters)],
    ["Samples for the posterior", count(report.samples_posterior)],
    [html`<${Term} of="effective-samples">Effective samples<//>`, count(report.independent_samples)],
    ["Calibration factor of the model’s std", number(calibration.function_std_factor)],
  ];
  if (report.arms) found.push(["Arms on one base", count(report.arms)]);
  if (report.fixed_joints) found.push(["Fixed at zero, not in the data", report.fixed_joints]);
  if (report.followed_joints) found.push(["Coupled by the URDF", report.followed_joints]);
  if (conformal) {
    found.push(
      ["Blocks for conformal prediction", count(conformal.blocks)],
      ["Interval factors", conformal.scale.map((each) => number(each, 3)).join(", ")],
      ["Guaranteed coverage of 95 % intervals", conformal.guaranteed.map((each) => percent(each)).join(", ")],
    );
  }
  for (const [prefix, text] of Object.entries(OF_JOINTS)) {
    const joints = Object.keys(report).filter((key) => key.startsWith(prefix)).map((key) => Number(key.slice(prefix.length))).sort((a, b) => a - b);
    if (joints.length) found.push([text, joints.map((joint) => `joint ${joint}: ${number(report[prefix + joint], 2)}`).join(", ")]);
  }
  if (compact) {
    found.push(
      [html`<${Term} of="inducing-outputs">Inducing outputs<//>`, count(compact.inducing_outputs)],
      ["Max deviation from the exact mean", `${percent(compact.mean_max)} of its std`],
      ["Max deviation from the exact std", percent(compact.std_max)],
      ["Tolerance reached", html`<${Badge} state=${compact.tolerance_reached ? "yes" : "no: tau_std is too large"} kind=${compact.tolerance_reached ? "good" : "warn"} />`],
    );
  }
  if (from.peak_memory_bytes) found.push(["Peak memory", bytes(from.peak_memory_bytes)]);
  return found;
}

function Range({ version: { joint_names: names, training_range: range } }) {
  const short = shortNames(names);
  const span = (quantity) => (joint) => `${number(range[quantity].min[joint])} to ${number(range[quantity].max[joint])}`;
  const columns = [
    { label: "Joint", cell: (joint) => html`<${Joint} index=${joint} name=${short[joint]} />` },
    { label: "q, rad", numeric: true, cell: span("q") },
    { label: "dq, rad/s", numeric: true, cell: span("dq") },
    { label: "ddq, rad/s²", numeric: true, cell: span("ddq") },
  ];
  return html`<${Card} title="Training range">
    <${Table} columns=${columns} rows=${names.map((_name, joint) => joint)} caption="Minimum and maximum (prismatic joints: m)" />
    <p class="hint">Outside these ranges the model extrapolates. Its intervals grow, but not always enough.</p>
  <//>`;
}
