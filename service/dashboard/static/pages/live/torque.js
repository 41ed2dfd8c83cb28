// Measured and predicted torque of every joint over the last half minute, with the 95 % interval of a measurement.

import { h, replace } from "../../dom.js";
import { shortNames, torqueUnit } from "../../format.js";
import { line, plot } from "../../plots.js";
import { card } from "../../ui.js";
import { WINDOW_S } from "./rows.js";

export const HALF_WIDTH = 1.96;
const MOST_DRAWN = 300;

/** Plots of all joints in a place; draw(rows) draws those that can be seen. */
export function torque(place, joints, types, signal) {
  const short = shortNames(joints);
  const plots = joints.map((name, joint) => ({ name, joint, title: short[joint], unit: torqueUnit(types[joint]), element: h("div", { style: "min-height: 190px" }), seen: false, made: null }));
  const watch = new IntersectionObserver((entries) => {
    for (const entry of entries) plots.find((each) => each.element === entry.target).seen = entry.isIntersecting;
  }, { rootMargin: "400px 0px" });
  plots.forEach((each) => watch.observe(each.element));
  signal.addEventListener("abort", () => watch.disconnect());
  replace(
    place,
    card(
      "Torque",
      h("p", { class: "hint" }, swatch("border-top: 3px solid var(--measured)"), "measured  ", swatch("border-top: 3px solid var(--predicted)"), "predicted before it was learnt  ", swatch("height: 0.8em; background: var(--predicted); opacity: 0.3"), "95 % of measurements are expected here: ± 1.96 √(std² + noise²)  ", h("b", { "aria-hidden": "true", style: "color: var(--contact)" }, "× "), "kept out of learning (at the edge: far off)"),
      h("div", { class: "grid", style: "margin: 0; gap: 0.4rem" }, plots.map((each) => each.element)),
    ),
  );
  const draw = async (each, rows) => {
    const range = reach(rows, each.joint);
    const traces = [...curves(thin(rows), each.joint, each.unit), keptOut(rows, each.joint, range)];
    const layout = {
      title: each.title,
      y: each.unit,
      height: 190,
      showlegend: false,
      margin: { l: 48, r: 8, t: 30, b: 28 },
      xaxis: { range: [-WINDOW_S, 0], ticksuffix: " s" },
      yaxis: { range },
      uirevision: "live",
    };
    const label = `${each.name}: torque measured and predicted over the last ${WINDOW_S} seconds`;
    if (each.made) await each.made.react(traces, layout);
    else each.made = await plot(each.element, traces, layout, { label, signal });
  };
  return {
    async draw(rows) {
      for (const each of plots) if (each.seen && !signal.aborted) await draw(each, rows);
    },
  };
}

/** Few enough rows for a line; the first after a gap stays, and those that were kept out. */
export function thin(rows) {
  const step = Math.ceil(rows.length / MOST_DRAWN);
  return step < 2 ? rows : rows.filter((row, index) => row.cut || index % step === 0 || odd(row));
}

/** Numbers with a hole before every row that does not go on from the one before. */
export function broken(rows, value) {
  return rows.flatMap((row) => (row.cut ? [null, value(row)] : [value(row)]));
}

function curves(rows, joint, unit) {
  const x = broken(rows, (row) => row.x);
  // a torque beyond all limits would leave nothing to see of the others
  const measured = broken(rows, (row) => (row.code === "limit" ? null : row.tau[joint]));
  return [
    ribbon(rows.filter((row) => row.mean[joint] !== null), joint),
    line(x, broken(rows, (row) => row.mean[joint]), "predicted", "predicted", { hovertemplate: `%{y:.4g} ${unit}` }),
    line(x, measured, "measured", "measured", { hovertemplate: `%{y:.4g} ${unit}`, line: { width: 1.2 } }),
  ];
}

// one closed shape for each unbroken piece: an area between two curves would bridge the gaps
function ribbon(rows, joint) {
  const pieces = [];
  for (const row of rows) {
    if (!pieces.length || row.cut) pieces.push([]);
    pieces.at(-1).push(row);
  }
  const edge = (row, side) => row.mean[joint] + side * HALF_WIDTH * row.std[joint];
  const around = (forth, back) => pieces.flatMap((piece) => [...piece.map(forth), ...piece.toReversed().map(back), null]);
  return {
    x: around((row) => row.x, (row) => row.x),
    y: around((row) => edge(row, -1), (row) => edge(row, 1)),
    mode: "lines", type: "scatter", fill: "toself", filled: true, colour: "predicted", line: { width: 0 }, hoverinfo: "skip", name: "95 %",
  };
}

function keptOut(rows, joint, [low, high]) {
  const kept = rows.filter(odd);
  return {
    x: kept.map((row) => row.x), y: kept.map((row) => Math.max(low, Math.min(high, row.tau[joint]))), mode: "markers", type: "scatter",
    colour: "contact", marker: { symbol: "x", size: 6 }, name: "kept out", hoverinfo: "skip",
  };
}

// what is worth a mark and must not make the others too small to see; a robot at rest, changed or with a payload goes on for long
function odd(row) {
  return !["learnt", "stationary", "limit", "change", "payload"].includes(row.code);
}

/** What the axis shows: all usual rows and their interval, and of those that were kept out as much again on either side. */
function reach(rows, joint) {
  const all = [Infinity, -Infinity];
  const usual = [Infinity, -Infinity];
  const widen = (range, y) => y !== null && ([range[0], range[1]] = [Math.min(range[0], y), Math.max(range[1], y)]);
  for (const row of rows) {
    if (row.code === "limit") continue;
    widen(all, row.tau[joint]);
    if (odd(row)) continue;
    widen(usual, row.tau[joint]);
    if (row.mean[joint] !== null) [-1, 1].forEach((side) => widen(usual, row.mean[joint] + side * HALF_WIDTH * row.std[joint]));
  }
  const [low, high] = usual[0] <= usual[1] ? usual : all;
  if (!(low <= high)) return [-1, 1];
  const span = Math.max(high - low, 1e-3);
  return [Math.max(Math.min(all[0], low), low - span) - 0.05 * span, Math.min(Math.max(all[1], high), high + span) + 0.05 * span];
}

function swatch(style) {
  return h("span", { "aria-hidden": "true", style: `display: inline-block; width: 1.4em; vertical-align: middle; margin: 0 0.3em 0 0.6em; ${style}` });
}
