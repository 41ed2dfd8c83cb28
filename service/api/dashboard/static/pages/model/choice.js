// Which version and which recording the page is about.

import { refresh } from "../../dom.js";
import { count } from "../../format.js";
import { empty, field, link, offer, select } from "../../ui.js";

const PARTS = [["held_out", "what training held out"], ["all", "all of it"]];

/** Data sets that a version can be compared with: those of its joints and its torque convention. */
export function fitting(version, datasets) {
  return datasets.filter(
    (each) =>
      each.torque_convention === version.torque_convention &&
      each.joint_names.length === version.joint_names.length &&
      each.joint_names.every((joint, index) => joint === version.joint_names[index]),
  );
}

/** What a version has to do with a data set: "trained on", "partly held out", "held out" or "". */
export function relation(version, dataset) {
  const same = (each) => each.id === dataset.id || each.sha256 === dataset.sha256;
  const held = version.lineage.holdout?.datasets?.find(same);
  if (held) return held.whole ? "held out" : "partly held out";
  return version.lineage.datasets?.some(same) ? "trained on" : "";
}

/** The data set and part to begin with: what was asked for, else what was held out, else what it has not seen, the newest first. */
export function firstChoice(version, datasets, query) {
  const offered = fitting(version, datasets);
  const asked = offered.find((each) => each.id === query.get("dataset"));
  const by = (...kinds) => offered.find((each) => kinds.includes(relation(version, each)));
  const dataset = asked ?? by("held out", "partly held out") ?? by("") ?? offered[0] ?? null;
  if (dataset === null) return { dataset: null, part: "all" };
  const has = relation(version, dataset).endsWith("held out");
  const part = has && query.get("part") !== "all" ? "held_out" : "all";
  return { dataset: dataset.id, part };
}

/**
 * The fields above the tabs, in a place of their own. changed(): the data set or part is another one; chosen(number): the
 * version. Returns a function of what a tab needs, which brings them up to date.
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
    const offered = fitting(version, datasets);
    const dataset = offered.find((each) => each.id === state.dataset);
    const data = needs.data && offered.length > 0;
    const part = data && dataset && relation(version, dataset).endsWith("held out");
    offer(versions, numbered(model), String(version.version));
    offer(recordings, offered.map((each) => [each.id, described(version, each)]), state.dataset);
    offer(parts, PARTS, state.part);
    refresh(place, needs.version ? fields.version : null, data ? fields.data : null, part ? fields.part : null);
  };
}

function numbered(model) {
  return [...model.versions].reverse().map((each) => {
    const role = each.version === model.serving_version ? ", answers now" : "";
    return [String(each.version), `${each.version} – ${each.estimator}${role}`];
  });
}

function described(version, dataset) {
  const known = relation(version, dataset);
  return `${dataset.name || dataset.id} – ${count(dataset.report.rows)} samples${known ? `, ${known}` : ", not seen in training"}`;
}

/** What is shown where no data set fits. */
export function noData({ version, datasets }) {
  const joints = version.joint_names.join(", ");
  const why = datasets.length
    ? `None of the ${count(datasets.length)} data sets has the joints of this model (${joints}) and its torque convention (${version.torque_convention}).`
    : `There is no data set yet to compare this model with.`;
  return empty(
    `${why} Upload a recording of this robot that the model was not trained on.`,
    link("Upload a recording", "#/data", "primary"),
  );
}
