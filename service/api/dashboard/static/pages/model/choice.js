// Selects for the version, the recording and its part.

import { refresh } from "../../dom.js";
import { count } from "../../format.js";
import { empty, field, link, select, updateSelect } from "../../ui.js";

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

/** Return the initial data set and part: from the address, else held out, else not used in training; the newest first. */
export function firstChoice(version, datasets, query) {
  const offered = compatible(version, datasets);
  const requested = offered.find((each) => each.id === query.get("dataset"));
  const by = (...kinds) => offered.find((each) => kinds.includes(trainingRole(version, each)));
  const dataset = requested ?? by("held out", "partly held out") ?? by("") ?? offered[0] ?? null;
  if (dataset === null) return { dataset: null, part: "all" };
  const has = trainingRole(version, dataset).endsWith("held out");
  const part = has && query.get("part") !== "all" ? "held_out" : "all";
  return { dataset: dataset.id, part };
}

/**
 * Create the selects above the tabs. changed(): called after a change of the data set or part; chosen(number): after a
 * change of the version. Returns a function that shows the selects which a tab needs, and updates them.
 */
export function chooser(place, state, changed, chosen) {
  const versions = select([], null, (value) => chosen(Number(value)));
  const recordings = select([], null, (id) => {
    state.dataset = id;
    Object.assign(state, firstChoice(state.version, state.datasets, new URLSearchParams({ dataset: id })));
    changed();
  });
  const parts = select(PARTS, state.part, (part) => {
    state.part = part;
    changed();
  });
  const fields = { version: field("Version", versions), data: field("Recording", recordings), part: field("Part", parts) };
  return (needs) => {
    const { model, version, datasets } = state;
    const offered = compatible(version, datasets);
    const dataset = offered.find((each) => each.id === state.dataset);
    const data = needs.data && offered.length > 0;
    const part = data && dataset && trainingRole(version, dataset).endsWith("held out");
    updateSelect(versions, versionOptions(model), String(version.version));
    updateSelect(recordings, offered.map((each) => [each.id, datasetLabel(version, each)]), state.dataset);
    updateSelect(parts, PARTS, state.part);
    refresh(place, needs.version ? fields.version : null, data ? fields.data : null, part ? fields.part : null);
  };
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

/** Return the empty state for a version without a matching data set. */
export function noData({ version, datasets }) {
  const joints = version.joint_names.join(", ");
  const why = datasets.length
    ? `None of the ${count(datasets.length)} data sets has the joints of this model (${joints}) and its torque convention (${version.torque_convention}).`
    : "There are no data sets yet.";
  return empty(
    `${why} Upload a recording of this robot that the model was not trained on.`,
    link("Upload a recording", "#/data", "primary"),
  );
}
