// Several versions on one recording: their traces over one another, their figures, and which is better if that can be told.

import { post } from "../../api.js";
import { coverageBars, errorBars, mean } from "../../charts.js";
import { h, replace } from "../../dom.js";
import { count, counted, nmse, number, percent, shortNames } from "../../format.js";
import { badge, button, card, errorBox, field, loading, select, table } from "../../ui.js";
import { fitting, noData, relation } from "./choice.js";
import { broken, column } from "./curves.js";
import { joints } from "./joints.js";

const SIGN = { no_difference: "plain", cannot_tell: "warn" };
const MOST = 4, POINTS = 1000;
const DASHES = ["solid", "dash", "dot", "dashdot"];

/** The form, and below it the answer. */
export function compareForm(state, signal) {
  const { model, version, datasets } = state;
  const offered = fitting(version, datasets);
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
    for (const [, box] of boxes) box.disabled = number_ >= MOST && !box.checked;
    go.disabled = number_ < 2;
    note.textContent = number_ < 2 ? "Choose at least two versions." : number_ >= MOST ? `${MOST} versions at most.` : "";
  };
  const dataset = select(offered.map((each) => [each.id, `${each.name || each.id}${relation(version, each) ? `, ${relation(version, each)}` : ""}`]), state.dataset);
  const answer = h("div", { "aria-live": "polite" }), plots = h("div", {});
  const go = button("Compare", async () => {
    replace(answer, loading("Comparing"));
    replace(plots);
    try {
      await compared(answer, plots, state, chosen().map((each) => each.version), dataset.value, signal);
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
    boxes.map(([each, box]) => h("label", {}, box, ` ${each.version}, ${each.estimator}${each.version === model.serving_version ? ", answers now" : ""}`)),
    note,
  );
  return [versions, field("Recording", dataset), h("p", {}, go), answer, plots];
}

async function compared(answer, plots, state, versions, dataset, signal) {
  const reference = versions.includes(state.model.serving_version) ? state.model.serving_version : versions[0];
  const others = versions.filter((each) => each !== reference);
  const order = [reference, ...others];
  const said = await Promise.all(others.map((each) => post(`${state.where}/compare`, { dataset, versions: [reference, each] }, signal)));
  replace(answer, figures(said), said.length === 1 ? verdict(said[0]) : said.map((each) => [sentence(each), inFull(each)]));
  const fetch = async (start, stop) => {
    const range = stop === null ? {} : { start, stop };
    const traces = await Promise.all(order.map((version) => post(`${state.where}/trace`, { dataset, version, part: "all", points: POINTS, ...range }, signal)));
    return { ...traces[0], joint_types: state.version.joint_types, means: traces.map((each) => each.mean) };
  };
  const along = h("div", {});
  replace(plots, card("Their torques along the recording", along));
  const torque = (trace, joint, x) => [
    broken(x, column(trace.tau, joint), trace.breaks, "measured", "measured", { line: { width: 3 }, opacity: 0.4 }),
    ...trace.means.map((rows, index) => drawn(x, column(rows, joint), trace.breaks, order, index)),
  ];
  const residual = (trace, joint, x) => {
    const tau = column(trace.tau, joint);
    return trace.means.map((rows, index) => drawn(x, column(rows, joint).map((value, row) => tau[row] - value), trace.breaks, order, index));
  };
  await joints(along, {
    first: await fetch(0, null),
    fetch,
    signal,
    views: { "residuals, measured − predicted": residual, "measured and predicted torque": torque },
    about: { "residuals, measured − predicted": "The nearer to zero, the better.", "measured and predicted torque": "Where the lines part, the versions differ." },
  });
}

function drawn(x, y, breaks, order, index) {
  return broken(x, y, breaks, `version ${order[index]}`, `version-${index + 1}`, { line: { width: 1.5, dash: DASHES[index] } });
}

/** A row for each version: the reference, which each of the comparisons has, and the others. */
function figures(said) {
  const names = shortNames(said[0].joint_names);
  const rows = [said[0].versions[0], ...said.map((each) => each.versions[1])];
  const figure = (values, format, bars) => h("div", { class: "figure" }, h("span", {}, format(mean(values))), bars(names, values));
  const columns = [
    { label: "Version", cell: (row) => [h("i", { class: "swatch", style: `background: var(--version-${rows.indexOf(row) + 1})` }), ` ${row.version}`, row.in_training ? h("span", { class: "hint" }, " trained on this: flatters") : null] },
    { label: "nMSE", cell: (row) => figure(row.nmse, nmse, errorBars) },
    { label: "In 95\u00a0%", cell: (row) => figure(row.coverage, (x) => percent(x, 0), coverageBars) },
    { label: "NLPD, nats", numeric: true, cell: (row) => number(mean(row.nlpd)) },
  ];
  return table(columns, rows, { caption: `Means of the joints on ${count(said[0].samples_used)} of ${counted(said[0].samples, "sample")}; bars show each joint` });
}

function sentence(said) {
  const label = said.better === null ? said.outcome.replace("_", " ") : `version ${said.better} is better`;
  return h("p", {}, badge(label, SIGN[said.outcome] ?? "good"), " ", said.verdict);
}

function verdict(said) {
  return [said.warnings.map((text) => h("div", { class: "banner", role: "note" }, `Unfair: ${text}.`)), sentence(said), byJoint(said)];
}

function inFull(said) {
  return h("details", {}, h("summary", {}, `Version ${said.versions[1].version} against ${said.versions[0].version}, joint by joint`), byJoint(said));
}

function byJoint(said) {
  const [one, two] = said.versions;
  const short = shortNames(said.joint_names);
  const difference = (joint) => {
    const { difference: by, half_width: half } = said.differences.nlpd;
    return `${number(by[joint])}${half[joint] === null ? "" : ` ± ${number(half[joint], 2)}`}`;
  };
  const numeric = (heading, cell) => ({ label: heading, numeric: true, cell });
  const columns = [
    { label: "Joint", cell: (joint) => short[joint] },
    numeric(`nMSE, v${one.version}`, (joint) => nmse(one.nmse[joint])),
    numeric(`nMSE, v${two.version}`, (joint) => nmse(two.nmse[joint])),
    numeric(`in 95\u00a0%, v${one.version}`, (joint) => percent(one.coverage[joint])),
    numeric(`in 95\u00a0%, v${two.version}`, (joint) => percent(two.coverage[joint])),
    numeric(`NLPD, v${two.version} − v${one.version}`, difference),
  ];
  return [
    table(columns, said.joint_names.map((_name, joint) => joint), { caption: `${count(said.samples_used)} of ${count(said.samples)} samples in ${counted(said.blocks, "block")}; ± is half of a 95\u00a0% interval` }),
    h("p", { class: "hint" }, "NLPD, the negative log predictive density, is small where errors are small and bands are true. A difference below zero: the second version is better."),
  ];
}
