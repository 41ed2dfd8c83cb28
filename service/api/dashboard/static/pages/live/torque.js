// Plots of the measured and predicted torque with 95 % intervals: one large plot, and a small one for each joint.

import { jointVar } from "../../colours.js";
import { h, replace } from "../../dom.js";
import { number, shortNames, torqueUnit } from "../../format.js";
import { line, plot } from "../../plots.js";
import { card } from "../../ui.js";
import { recentInnovations, largestJoint } from "./scores.js";

export const HALF_WIDTH = 1.96;
const MAX_POINTS = 300;
const SMALL = { height: 110, margin: { l: 34, r: 4, t: 4, b: 16 }, most: 120 };
const LARGE = { height: 320, margin: { l: 52, r: 8, t: 8, b: 28 }, most: MAX_POINTS };
const FULL_BAR_STD = 8; // innovation that fills the bar of a joint

/**
 * Create the plots. view: {window, joint, cursor}; joint null: the one with the largest recent innovation;
 * pick(joint): called when a joint is selected. Returns {draw(rows), point()}; point() shows the values at the cursor.
 */
export function torque(place, joints, types, view, linked, { pick, signal }) {
  const short = shortNames(joints);
  const large = figure(h("h3", { class: "joint" }), LARGE, "large");
  const made = joints.map((name, joint) => {
    const button = h("button", { type: "button", class: "joint", style: `--own: ${jointVar(joint)}`, onclick: () => pick(view.joint === joint ? null : joint) }, short[joint]);
    button.setAttribute("aria-label", `Show ${name} large`);
    return { ...figure(button, SMALL, "small"), name, joint, button };
  });
  const watch = new IntersectionObserver((entries) => {
    for (const entry of entries) [large, ...made].find((each) => each.element === entry.target).seen = entry.isIntersecting;
  }, { rootMargin: "300px 0px" });
  [large, ...made].forEach((each) => watch.observe(each.element));
  signal.addEventListener("abort", () => watch.disconnect());
  const why = h("span", { class: "muted" });
  large.head.append(why);
  replace(
    place,
    card(
      "Torque",
      large.element,
      h("p", { class: "hint" }, swatch("border-top: 3px solid var(--measured)"), "measured  ", swatch("border-top: 3px solid var(--predicted)"), "predicted before learning  ", swatch("height: 0.8em; background: var(--predicted); opacity: 0.3"), "95 % interval of measurements: ± 1.96 √(std² + noise²)  ", h("b", { "aria-hidden": "true", style: "color: var(--contact)" }, "× "), "rejected (at the edge: outside the plot)"),
      h("div", { class: "multiples" }, made.map((each) => each.element)),
    ),
  );

  let shown = null, chosen = false, last = [];
  const draw = async (each, joint, range, label) => {
    const rows = thin(last, each.size.most);
    const reach = axisRange(rows, joint);
    const traces = [...curves(rows, joint), rejectedMarks(last, joint, reach)];
    const small = each.size === SMALL;
    const layout = {
      y: small ? "" : torqueUnit(types[joint]),
      height: each.size.height,
      showlegend: false,
      hovermode: false,
      dragmode: false,
      margin: each.size.margin,
      xaxis: { range, zeroline: false, ticksuffix: " s", nticks: small ? 4 : 8, automargin: false, tickfont: small ? { size: 10 } : {} },
      yaxis: { range: reach, nticks: small ? 4 : 8, automargin: false, tickfont: small ? { size: 10 } : {} },
    };
    each.plot.setAttribute("aria-label", label);
    if (each.made) return each.made.react(traces, layout);
    each.made = await plot(each.plot, traces, layout, { label, signal });
    if (!signal.aborted) linked.add(each.plot);
  };
  const point = () => {
    const at = view.cursor === null ? null : closest(last, view.cursor);
    large.value.textContent = at ? values(at, shown, torqueUnit(types[shown])) : "";
    for (const each of made) each.value.textContent = at ? values(at, each.joint, "") : `${number(each.score ?? 0, 2)} σ`;
  };
  return {
    point,
    async draw(rows) {
      last = rows;
      const scores = recentInnovations(rows, joints);
      shown = view.joint ?? largestJoint(scores, chosen ? null : shown);
      chosen = view.joint !== null;
      large.title.textContent = short[shown];
      large.element.style.setProperty("--own", jointVar(shown));
      why.textContent = view.joint === null ? `largest recent innovation: ${number(scores[shown], 2)} σ` : "selected";
      for (const each of made) {
        each.score = scores[each.joint];
        each.element.classList.toggle("largest", each.joint === shown);
        each.button.setAttribute("aria-pressed", String(view.joint === each.joint));
        each.element.style.setProperty("--of", String(Math.min(scores[each.joint] / FULL_BAR_STD, 1)));
        each.element.classList.toggle("far", scores[each.joint] > FULL_BAR_STD);
      }
      point();
      const range = [-span(rows, view.window), 0];
      const text = (name) => `${name}: torque measured and predicted over the last ${-range[0]} seconds`;
      if (large.seen || !large.made) await draw(large, shown, range, `${text(joints[shown])}, large`);
      for (const each of made) if ((each.seen || !each.made) && !signal.aborted) await draw(each, each.joint, range, text(each.name));
      return shown;
    },
  };
}

/** Create the frame of a plot: a head with name and value, and a place of fixed size. */
function figure(title, size, kind) {
  const value = h("span", { class: "value" });
  const head = h("div", { class: "head" }, title, value);
  const place = h("div", { style: `height: ${size.height}px` });
  return { title, value, head, size, plot: place, seen: false, made: null, element: h("div", { class: `trace ${kind}` }, head, place) };
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

function values({ tau, mean }, joint, unit) {
  const [measured, predicted] = [tau[joint], mean[joint]].map((each) => (each === null ? "–" : unit ? each.toFixed(2) : number(each, 2)));
  return unit ? `measured ${measured}, predicted ${predicted} ${unit}` : `${measured} | ${predicted}`;
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
    line(x, withGaps(rows, (row) => row.mean[joint]), "predicted", "predicted"),
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
    mode: "lines", type: "scatter", fill: "toself", filled: true, colour: "predicted", line: { width: 0 }, hoverinfo: "skip", name: "95 %",
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
  const span = Math.max(high - low, 1e-3);
  return [Math.max(Math.min(all[0], low), low - span) - 0.05 * span, Math.min(Math.max(all[1], high), high + span) + 0.05 * span];
}

function swatch(style) {
  return h("span", { "aria-hidden": "true", style: `display: inline-block; width: 1.4em; vertical-align: middle; margin: 0 0.3em 0 0.6em; ${style}` });
}
