// The measured and predicted torque of each joint with 95 % intervals, each joint on its own scale.

import { jointVar } from "../../colours.js";
import { Card } from "../../components.js";
import { number, shortNames, torqueUnit } from "../../format.js";
import { line } from "../../plots.js";
import { html } from "../../preact.js";
import { LivePlot } from "./live_plot.js";

export const HALF_WIDTH = 1.96;
const MAX_POINTS = 300;
const SMALL = { height: 130, most: 150, ticks: 4 }, LARGE = { height: 320, most: MAX_POINTS, ticks: 8 };
const MIN_SPAN = 1e-3, MIN_SHARE = 0.01; // of an axis: N·m, and share of the torque, whose labels would be too long
const FULL_BAR_STD = 8; // innovation that fills the bar of a joint

/** A plot of each joint; the picked one is large. cursor: time in s, or null; pick(joint): called when a joint is selected. */
export function Torque({ shown, joints, types, window, scores, largest, picked, cursor, linked, pick }) {
  const short = shortNames(joints), at = cursor === null ? null : closest(shown, cursor);
  const range = [-span(shown, window), 0];
  const value = (joint) => {
    if (!at) return `${number(scores[joint], 2)} σ${joint === largest ? ", largest" : ""}`;
    const [measured, predicted] = [at.tau[joint], at.mean[joint]].map((each) => (each === null ? "–" : each.toFixed(2)));
    return joint === picked ? `measured ${measured}, predicted ${predicted} ${torqueUnit(types[joint])}` : `${measured} | ${predicted}`;
  };
  const kinds = (joint) => ["trace", joint === picked ? "large" : "small", joint === largest && "largest", scores[joint] > FULL_BAR_STD && "far"].filter(Boolean).join(" ");
  const one = (name, joint) => html`<div key=${name} class=${kinds(joint)} style=${{ "--own": jointVar(joint), "--of": Math.min(scores[joint] / FULL_BAR_STD, 1) }}>
    <div class="head">
      <button type="button" class="joint" aria-pressed=${String(joint === picked)} aria-label=${`Show ${name} large`} onClick=${() => pick(joint)}>${short[joint]}</button>
      <span class="muted">${torqueUnit(types[joint])}</span>
      <span class="value">${value(joint)}</span>
    </div>
    <${Plot} shown=${shown} joint=${joint} range=${range} size=${joint === picked ? LARGE : SMALL} linked=${linked} label=${`${name}: torque measured and predicted over the last ${-range[0]} seconds`} />
  </div>`;
  return html`<${Card} title="Torque">
    <p class="hint legend"><span class="measured">measured</span> <span class="predicted">predicted before learning, in the colour of the joint</span> <span class="interval">95 % interval of measurements</span> <span class="rejected">rejected (at the edge: outside the plot)</span> σ: largest innovation of the last seconds, in standard deviations</p>
    <div class="multiples">${joints.map(one)}</div>
  <//>`;
}

function Plot({ shown, joint, range, size, linked, label }) {
  const make = () => {
    const rows = thin(shown, size.most), reach = axisRange(rows, joint);
    const tickfont = { size: size === SMALL ? 11 : 12.5 };
    const layout = {
      height: size.height, showlegend: false, hovermode: false, dragmode: false, margin: { l: 52, r: 6, t: 6, b: 24 },
      xaxis: { range, zeroline: false, ticksuffix: " s", nticks: size.ticks, automargin: false, tickfont },
      yaxis: { range: reach, nticks: size.ticks, automargin: false, tickfont },
    };
    return { traces: [...curves(rows, joint), rejectedMarks(shown, joint, reach)], layout };
  };
  return html`<${LivePlot} make=${make} inputs=${[shown, size]} height=${size.height} label=${label} linked=${linked} />`;
}

/** Return the seconds of a window that the x axis shows: fewer while there are only a few rows. */
export function span(rows, window) {
  const there = rows.length ? -rows[0].x : 0;
  return [2, 5, 10, 30, 60, window].find((each) => each >= there && each <= window) ?? window;
}

/** Return the row nearest to x; null if there are none. */
export function closest(rows, x) {
  return rows.reduce((best, row) => (best === null || Math.abs(row.x - x) < Math.abs(best.x - x) ? row : best), null);
}

/** Thin rows for a line; keep the first row after a gap and the rejected rows. */
export function thin(rows, most = MAX_POINTS) {
  const step = Math.ceil(rows.length / most);
  return step < 2 ? rows : rows.filter((row, index) => row.cut || index % step === 0 || isRejected(row));
}

/** Return values with a null before each row that follows a gap. */
export function withGaps(rows, value) {
  return rows.flatMap((row) => (row.cut ? [null, value(row)] : [value(row)]));
}

function curves(rows, joint) {
  const x = withGaps(rows, (row) => row.x);
  // a torque beyond the limits would compress all other values
  const measured = withGaps(rows, (row) => (row.code === "limit" ? null : row.tau[joint]));
  return [
    ribbon(rows.filter((row) => row.mean[joint] !== null), joint),
    line(x, withGaps(rows, (row) => row.mean[joint]), "predicted", joint),
    line(x, measured, "measured", "measured", { line: { width: 1.2 } }),
  ];
}

// a closed shape for each piece: an area between two curves would bridge the gaps
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
    mode: "lines", type: "scatter", fill: "toself", filled: true, colour: joint, line: { width: 0 }, hoverinfo: "skip", name: "95 %",
  };
}

function rejectedMarks(rows, joint, [low, high]) {
  const kept = rows.filter(isRejected);
  return {
    x: kept.map((row) => row.x), y: kept.map((row) => Math.max(low, Math.min(high, row.tau[joint]))), mode: "markers", type: "scatter",
    colour: "contact", marker: { symbol: "x", size: 6 }, name: "rejected", hoverinfo: "skip",
  };
}

// rows to mark; the listed codes are usual, or last too long to mark every row
function isRejected(row) {
  return !["learnt", "stationary", "limit", "change", "payload", "paused"].includes(row.code);
}

/** Return the range of the axis: all usual rows with their intervals; rejected rows extend it by its size at most. */
function axisRange(rows, joint) {
  const all = [Infinity, -Infinity];
  const usual = [Infinity, -Infinity];
  const widen = (range, y) => y !== null && ([range[0], range[1]] = [Math.min(range[0], y), Math.max(range[1], y)]);
  for (const row of rows) {
    if (row.code === "limit") continue;
    widen(all, row.tau[joint]);
    if (isRejected(row)) continue;
    widen(usual, row.tau[joint]);
    if (row.mean[joint] !== null) [-1, 1].forEach((side) => widen(usual, row.mean[joint] + side * HALF_WIDTH * row.std[joint]));
  }
  const [low, high] = usual[0] <= usual[1] ? usual : all;
  if (!(low <= high)) return [-1, 1];
  const span = Math.max(high - low, MIN_SPAN, MIN_SHARE * Math.max(Math.abs(low), Math.abs(high)));
  const around = 0.05 * span + (span - (high - low)) / 2;
  return [Math.max(Math.min(all[0], low), low - span) - around, Math.min(Math.max(all[1], high), high + span) + around];
}
