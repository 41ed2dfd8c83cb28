// Selects for the version, the recording and its part.

import { Choice, Empty, Link } from "../../components.js";
import { count } from "../../format.js";
import { html } from "../../preact.js";

const PARTS = [["held_out", "held-out part"], ["all", "whole recording"]];

/** Return the data sets with the joints and the torque convention of a version. */
export function compatible(version, datasets) {
  return datasets.filter(
    (each) =>
      each.torque_convention === version.torque_convention &&
      each.joint_names.length === version.joint_names.length &&
      each.joint_names.every((joint, index) => joint === version.joint_names[index]),
  );
}

/** Return the role of a data set in the training of a version: "trained on", "partly held out", "held out" or "". */
export function trainingRole(version, dataset) {
  const same = (each) => each.id === dataset.id || each.sha256 === dataset.sha256;
  const held = version.lineage.holdout?.datasets?.find(same);
  if (held) return held.whole ? "held out" : "partly held out";
  return version.lineage.datasets?.some(same) ? "trained on" : "";
}

/** Return the data set and part to show: the wanted ones, else held out, else not used in training; the newest first. */
export function chooseData(version, datasets, wanted) {
  const offered = compatible(version, datasets);
  const by = (...kinds) => offered.find((each) => kinds.includes(trainingRole(version, each)));
  const dataset = offered.find((each) => each.id === wanted.dataset) ?? by("held out", "partly held out") ?? by("") ?? offered[0] ?? null;
  if (dataset === null) return { dataset, part: "all" };
  return { dataset, part: hasPart(version, dataset) && wanted.part !== "all" ? "held_out" : "all" };
}

/** The selects that a tab needs. */
export function Choices({ model, version, datasets, dataset, part, needs, view, setWanted }) {
  const offered = compatible(version, datasets);
  const data = needs.includes("data") && dataset !== null;
  const want = (id, which) => setWanted({ version: version.version, dataset: id, part: which });
  return html`<div class="grid">
    ${needs.includes("version") && html`<${Choice} label="Version" options=${versionOptions(model)} value=${String(version.version)} onchange=${(value) => view(Number(value))} />`}
    ${data && html`<${Choice} label="Recording" options=${offered.map((each) => [each.id, datasetLabel(version, each)])} value=${dataset.id} onchange=${(id) => want(id, null)} />`}
    ${data && hasPart(version, dataset) && html`<${Choice} label="Part" options=${PARTS} value=${part} onchange=${(which) => want(dataset.id, which)} />`}
  </div>`;
}

/** The empty state for a version without a matching data set. */
export function NoData({ version, datasets }) {
  const why = datasets.length
    ? `None of the ${count(datasets.length)} data sets has the joints of this model (${version.joint_names.join(", ")}) and its torque convention (${version.torque_convention}).`
    : "There are no data sets yet.";
  return html`<${Empty} text=${`${why} Upload a recording of this robot that the model was not trained on.`}><${Link} to="#/data" kind="primary">Upload a recording<//><//>`;
}

function hasPart(version, dataset) {
  return trainingRole(version, dataset).endsWith("held out");
}

function versionOptions(model) {
  return [...model.versions].reverse().map((each) => {
    const role = each.version === model.serving_version ? ", serving" : "";
    return [String(each.version), `${each.version} – ${each.estimator}${role}`];
  });
}

function datasetLabel(version, dataset) {
  const known = trainingRole(version, dataset);
  return `${dataset.name || dataset.id} – ${count(dataset.report.rows)} samples${known ? `, ${known}` : ", not used in training"}`;
}
