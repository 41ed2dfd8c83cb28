// Where a version comes from: data, what was held out, options, what the fit said, software.

import { h, replace } from "../../dom.js";
import { bytes, count, number, percent, scientific, seconds, shortNames, when } from "../../format.js";
import { badge, card, facts, link, table } from "../../ui.js";
import { heldOut, JUDGED } from "../job/words.js";
import { selectionCard } from "./selection.js";

/** The tab of a version's lineage. */
export async function lineage(view, { version, datasets }) {
  const from = version.lineage;
  replace(
    view,
    card(`Version ${version.version}`, facts(origin(version))),
    selectionCard(version),
    dataCard(from, datasets),
    figuresCard(version, from),
    card("Fit", facts(fit(version)), version.fit.converged === false ? h("p", { class: "banner" }, "The fit stopped before it converged. More iterations may give a better model.") : null),
    rangeCard(version),
    card(
      "Options and software",
      facts(Object.entries({ ...version.options, ...from.software }).map(([name, value]) => [name.replaceAll("_", " "), String(value).replace(/^([0-9a-f]{12})[0-9a-f]{28}/, "$1")])), // a commit in short
    ),
    h("details", {}, h("summary", {}, "All of it as JSON"), h("pre", { tabindex: "0" }, h("code", {}, JSON.stringify({ lineage: from, fit: version.fit, compact: version.compact, calibration: version.calibration, robot: version.robot && { ...version.robot, urdf: undefined } }, null, 2)))),
  );
}

function origin(version) {
  const from = version.lineage;
  const found = [
    ["Model", version.model],
    ["Made", when(version.created_at)],
    ["Made by", version.job ? link("a training job", `#/jobs/${version.job}`) : from.imported ? "import" : "LIPServe, which it came with"],
    ["Estimator", version.estimator],
    ["Joints", version.joint_names.length < 3 ? version.joint_names.join(", ") : `${version.joint_names.length}, ${version.joint_names[0]} to ${version.joint_names.at(-1)}`],
    ["Torque", version.torque_convention.replace("_", " ")],
    ["Noise of the measurement, N·m", version.noise_std.map((each) => number(each, 2)).join(", ")],
  ];
  if (version.robot?.name) found.push(["Robot", version.robot.name]);
  if (from.base) found.push(["Transferred from", `${from.base.model} version ${from.base.version}`]);
  if (from.refresh) found.push(["Refresh of", `version ${from.refresh.version}`]);
  if (from.log) found.push(["Rows learnt from the log", `${count(from.log.rows)} of ${count(from.log.found)}`]);
  if (from.made_by) found.push(["Made with", from.made_by]);
  return found;
}

function dataCard(from, datasets) {
  if (!from.datasets?.length) {
    const said = from.simulation ? "It was trained on simulated motion, on another machine." : from.imported ? "It was imported; its archive names no data set." : "No data set is recorded for it.";
    return card("Trained on", h("p", {}, said));
  }
  const known = new Set(datasets.map((each) => each.id));
  const held = (row) => from.holdout?.datasets.find((each) => each.id === row.id);
  const columns = [
    { label: "Data set", cell: (row) => (known.has(row.id) ? link(row.name || row.id, `#/data/${row.id}`) : `${row.name || row.id} (deleted)`) },
    { label: "Samples", numeric: true, cell: (row) => count(row.rows) },
    { label: "Held out", numeric: true, cell: (row) => (held(row) ? `${count(held(row).rows)}${held(row).whole ? " (all)" : ""}` : "–") },
    { label: "Guard (used for neither)", numeric: true, cell: (row) => (held(row) ? count(held(row).guarded) : "–") },
    { label: "Content (sha256)", cell: (row) => h("code", { title: row.sha256 }, row.sha256?.slice(0, 12) ?? "–") },
  ];
  return card("Trained on", table(columns, from.datasets));
}

function figuresCard(version, from) {
  const sets = [
    ["Held out", from.holdout?.nmse ? from.holdout : null],
    ["Trained on (flatters)", from.training_metrics],
  ].filter(([, figures]) => figures);
  if (!sets.length) return null;
  const short = shortNames(version.joint_names);
  const columns = [
    { label: "Joint", cell: (joint) => short[joint] },
    ...sets.flatMap(([label, figures]) => [
      { label: `${label}: nMSE`, numeric: true, cell: (joint) => scientific(figures.nmse[joint]) },
      { label: "RMSE, N·m", numeric: true, cell: (joint) => number(figures.rmse[joint]) },
      { label: "in 95 %", numeric: true, cell: (joint) => percent(figures.coverage[joint]) },
    ]),
  ];
  const said = sets.map(([label, figures]) => `${label.toLowerCase()}: ${count(figures.samples)} of ${count(figures.of)} samples`).join("; ");
  return card(
    "Figures as trained",
    table(columns, version.joint_names.map((_name, joint) => joint), { caption: said }),
    from.holdout ? h("p", { class: "hint" }, `Held out: ${heldOut(from.holdout.split)}. ${from.holdout.learnt ? JUDGED : ""}`) : h("p", { class: "hint" }, "Nothing was held out. Evaluate it on a recording that it has not seen."),
  );
}

/** Entries of a fit's report that end with a joint's number: what they are called. */
const OF_JOINTS = { right_angle_: "Axis at right angles, how probably", local_: "Corrected where motion repeats, error left", widened_: "Intervals widened by what was held out" };

function fit({ fit: said, compact, calibration, conformal, lineage: from }) {
  const found = [
    ["Converged", badge(said.converged ? "yes" : "no", said.converged ? "good" : "warn")],
    ["Iterations", count(said.iterations)],
    ["Took", seconds(said.seconds)],
    ["Samples given", count(said.samples_given)],
    ["Samples for the hyperparameters", count(said.samples_hyperparameters)],
    ["Samples of the posterior", count(said.samples_posterior)],
    ["Independent samples among them", count(said.independent_samples)],
    ["Model’s std multiplied by", number(calibration.function_std_factor)],
  ];
  if (conformal) {
    found.push(
      ["Blocks left out to check the intervals", count(conformal.blocks)],
      ["Intervals widened by", conformal.scale.map((each) => number(each, 3)).join(", ")],
      ["Guaranteed of their 95 %", conformal.guaranteed.map((each) => percent(each)).join(", ")],
    );
  }
  for (const [prefix, text] of Object.entries(OF_JOINTS)) {
    const joints = Object.keys(said).filter((key) => key.startsWith(prefix)).map((key) => Number(key.slice(prefix.length))).sort((a, b) => a - b);
    if (joints.length) found.push([text, joints.map((joint) => `joint ${joint}: ${number(said[prefix + joint], 2)}`).join(", ")]);
  }
  if (compact) {
    found.push(
      ["Inducing outputs", count(compact.inducing_outputs)],
      ["Mean, farthest from the exact one", `${percent(compact.mean_max)} of its std`],
      ["Std, farthest from the exact one", percent(compact.std_max)],
      ["Tolerance reached", badge(compact.tolerance_reached ? "yes" : "no: tau_std is larger than the data would allow", compact.tolerance_reached ? "good" : "warn")],
    );
  }
  if (from.peak_memory_bytes) found.push(["Most memory", bytes(from.peak_memory_bytes)]);
  return found;
}

function rangeCard({ joint_names: names, training_range: range }) {
  const short = shortNames(names);
  const span = (quantity) => (joint) => `${number(range[quantity].min[joint])} to ${number(range[quantity].max[joint])}`;
  const columns = [
    { label: "Joint", cell: (joint) => short[joint] },
    { label: "q, rad", numeric: true, cell: span("q") },
    { label: "dq, rad/s", numeric: true, cell: span("dq") },
    { label: "ddq, rad/s²", numeric: true, cell: span("ddq") },
  ];
  return card(
    "Range of its samples",
    table(columns, names.map((_name, joint) => joint), { caption: "Smallest and largest values (sliding joints: m)" }),
    h("p", { class: "hint" }, "Outside these ranges it guesses. Its bands grow there, but not always enough."),
  );
}
