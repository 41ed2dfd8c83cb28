// Comparison of versions on one recording: figures, verdict, and their torques in one plot.

import { post } from "../../api.js";
import { coverageBars, errorBars, mean } from "../../charts.js";
import { h, replace } from "../../dom.js";
import { count, counted, nmse, number, percent, sentence, shortNames } from "../../format.js";
import { badge, button, card, errorBox, field, loading, select, table } from "../../ui.js";
import { compatible, noData, trainingRole } from "./choice.js";
import { lineWithGaps, column } from "./curves.js";
import { jointPlots } from "./joints.js";
import { verdictBadge } from "../verdict.js";

const BADGE_KINDS = { no_difference: "plain", cannot_tell: "warn" };
const MAX_VERSIONS = 4, POINTS = 1000;
const DASHES = ["solid", "dash", "dot", "dashdot"];

/** Create the form, followed by the place of its results. */
export function compareForm(state, signal) {
  const { model, version, datasets } = state;
  const offered = compatible(version, datasets);
  if (!offered.length) return noData(state);
  const newest = [...model.versions].reverse();
  const other = newest.find((each) => each.version !== model.serving_version).version;
  const boxes = newest.map((each) => {
    const checked = [model.serving_version ?? model.versions[0].version, other].includes(each.version);
    const box = h("input", { type: "checkbox", name: "versions", value: String(each.version), checked, onchange: () => limit() });
    return [each, box];
  });
  const chosen = () => boxes.filter(([, box]) => box.checked).map(([each]) => each);
  const note = h("p", { class: "hint", role: "status" });
  const limit = () => {
    const number_ = chosen().length;
    for (const [, box] of boxes) box.disabled = number_ >= MAX_VERSIONS && !box.checked;
    go.disabled = number_ < 2;
    note.textContent = number_ < 2 ? "Select at least two versions." : number_ >= MAX_VERSIONS ? `Max ${MAX_VERSIONS} versions.` : "";
  };
  const dataset = select(offered.map((each) => [each.id, `${each.name || each.id}${trainingRole(version, each) ? `, ${trainingRole(version, each)}` : ""}`]), state.dataset);
  const answer = h("div", { "aria-live": "polite" }), plots = h("div", {});
  const go = button("Compare", async () => {
    replace(answer, loading("Comparing"));
    replace(plots);
    try {
      await compareVersions(answer, plots, state, chosen().map((each) => each.version), dataset.value, signal);
    } catch (error) {
      if (error.name !== "AbortError") replace(answer, errorBox(error));
    }
    limit();
  }, { kind: "primary" });
  limit();
  const versions = h(
    "fieldset",
    { class: "choices" },
    h("legend", {}, "Versions"),
    boxes.map(([each, box]) => h("label", {}, box, ` ${each.version}, ${each.estimator}${each.version === model.serving_version ? ", serving" : ""}`)),
    note,
  );
  return [versions, field("Recording", dataset), h("p", {}, go), answer, plots];
}

async function compareVersions(answer, plots, state, versions, dataset, signal) {
  const reference = versions.includes(state.model.serving_version) ? state.model.serving_version : versions[0];
  const others = versions.filter((each) => each !== reference);
  const order = [reference, ...others];
  const comparisons = await Promise.all(others.map((each) => post(`${state.where}/compare`, { dataset, versions: [reference, each] }, signal)));
  replace(answer, figures(comparisons), comparisons.length === 1 ? verdict(comparisons[0]) : comparisons.map((each) => [verdictLine(each), detailsByJoint(each)]));
  const fetch = async (start, stop) => {
    const range = stop === null ? {} : { start, stop };
    const traces = await Promise.all(order.map((version) => post(`${state.where}/trace`, { dataset, version, part: "all", points: POINTS, ...range }, signal)));
    return { ...traces[0], joint_types: state.version.joint_types, means: traces.map((each) => each.mean) };
  };
  const along = h("div", {});
  replace(plots, card("Torques along the recording", along));
  const torque = (trace, joint, x) => [
    lineWithGaps(x, column(trace.tau, joint), trace.breaks, "measured", "measured", { line: { width: 3 }, opacity: 0.4 }),
    ...trace.means.map((rows, index) => versionLine(x, column(rows, joint), trace.breaks, order, index)),
  ];
  const residual = (trace, joint, x) => {
    const tau = column(trace.tau, joint);
    return trace.means.map((rows, index) => versionLine(x, column(rows, joint).map((value, row) => tau[row] - value), trace.breaks, order, index));
  };
  await jointPlots(along, {
    first: await fetch(0, null),
    fetch,
    signal,
    views: { "residuals, measured − predicted": residual, "measured and predicted torque": torque },
    about: { "residuals, measured − predicted": "Values nearer to zero are better.", "measured and predicted torque": "The versions differ where their lines differ." },
  });
}

function versionLine(x, y, breaks, order, index) {
  return lineWithGaps(x, y, breaks, `version ${order[index]}`, `version-${index + 1}`, { line: { width: 1.5, dash: DASHES[index] } });
}

/** Return a table with a row for the reference, which is part of every comparison, and for each other version. */
function figures(comparisons) {
  const names = shortNames(comparisons[0].joint_names);
  const rows = [comparisons[0].versions[0], ...comparisons.map((each) => each.versions[1])];
  const figure = (values, format, bars) => h("div", { class: "figure" }, h("span", {}, format(mean(values))), bars(names, values));
  const columns = [
    { label: "Version", cell: (row) => [h("i", { class: "swatch", style: `background: var(--version-${rows.indexOf(row) + 1})` }), ` ${row.version}`, row.in_training ? h("span", { class: "hint" }, " trained on this recording: optimistic") : null] },
    { label: "Verdict", cell: (row) => verdictBadge(row.verdict) },
    { label: "nMSE", cell: (row) => figure(row.nmse, nmse, errorBars) },
    { label: "95\u00a0% coverage", cell: (row) => figure(row.coverage, (x) => percent(x, 0), coverageBars) },
    { label: "NLPD, nats", numeric: true, cell: (row) => number(mean(row.nlpd)) },
  ];
  return table(columns, rows, { caption: `Means over the joints on ${count(comparisons[0].samples_used)} of ${counted(comparisons[0].samples, "sample")}; bars show each joint` });
}

function verdictLine(comparison) {
  const label = comparison.better === null ? comparison.outcome.replace("_", " ") : `version ${comparison.better} is better`;
  return h("p", {}, badge(label, BADGE_KINDS[comparison.outcome] ?? "good"), " ", comparison.verdict);
}

function verdict(comparison) {
  return [comparison.warnings.map((text) => h("div", { class: "banner", role: "note" }, `Biased comparison. ${sentence(text)}`)), verdictLine(comparison), byJoint(comparison)];
}

function detailsByJoint(comparison) {
  return h("details", {}, h("summary", {}, `Version ${comparison.versions[1].version} compared with ${comparison.versions[0].version}, by joint`), byJoint(comparison));
}

function byJoint(comparison) {
  const [one, two] = comparison.versions;
  const short = shortNames(comparison.joint_names);
  const difference = (joint) => {
    const { difference: by, half_width: half } = comparison.differences.nlpd;
    return `${number(by[joint])}${half[joint] === null ? "" : ` ± ${number(half[joint], 2)}`}`;
  };
  const numeric = (heading, cell) => ({ label: heading, numeric: true, cell });
  const columns = [
    { label: "Joint", cell: (joint) => short[joint] },
    numeric(`nMSE, v${one.version}`, (joint) => nmse(one.nmse[joint])),
    numeric(`nMSE, v${two.version}`, (joint) => nmse(two.nmse[joint])),
    numeric(`95\u00a0% coverage, v${one.version}`, (joint) => percent(one.coverage[joint])),
    numeric(`95\u00a0% coverage, v${two.version}`, (joint) => percent(two.coverage[joint])),
    numeric(`NLPD, v${two.version} − v${one.version}`, difference),
  ];
  return [
    table(columns, comparison.joint_names.map((_name, joint) => joint), { caption: `${count(comparison.samples_used)} of ${count(comparison.samples)} samples in ${counted(comparison.blocks, "block")}; ±: half-width of the 95\u00a0% interval` }),
    h("p", { class: "hint" }, "NLPD, the negative log predictive density, is low if errors are small and intervals are correct. If the difference is below zero, the second version is better."),
  ];
}
