// Torques along a recording as traces of Plotly: lines with gaps between episodes, and their intervals.

import { line } from "../../plots.js";

/** Half-width of a Gaussian's 95 % interval, in standard deviations. */
export const Z95 = 1.959963984540054;

const SHOWN_PAUSE = 0.05; // length of a cut pause, as a share of the motion

/** Return the standard deviation of a measurement: uncertainty of the model and noise, times the version's scale. */
export function measurementStd(trace, joint) {
  const noise = trace.noise_std[joint], scale = trace.scale[joint];
  return trace.std.map((row) => scale * Math.hypot(row[joint], noise));
}

/** Return the values of a joint. */
export function column(rows, joint) {
  return rows.map((row) => row[joint]);
}

/**
 * Return the horizontal axis of a trace: time since the origin, or row numbers if the time of an episode starts again.
 * Pauses that are longer than the motion are cut; `isCut` tells whether there are any.
 */
export function axis(trace, origin) {
  const { t, breaks } = trace;
  if (!t.every((value, index) => index === 0 || value >= t[index - 1])) return { x: trace.rows, suffix: "", isCut: false };
  const pauses = new Map(breaks.map((at) => [at, t[at] - t[at - 1]]));
  const motion = t.at(-1) - t[0] - [...pauses.values()].reduce((sum, each) => sum + each, 0);
  let removed = 0;
  const x = t.map((value, index) => {
    if (pauses.get(index) > motion) removed += pauses.get(index) - SHOWN_PAUSE * motion;
    return value - origin - removed;
  });
  return { x, suffix: " s", isCut: removed > 0 };
}

/** Return a line with gaps at the breaks of the trace. */
export function lineWithGaps(x, y, breaks, name, colour, extra = {}) {
  const at = new Set(breaks), xs = [], ys = [];
  x.forEach((value, index) => {
    if (at.has(index)) {
      xs.push(value);
      ys.push(null);
    }
    xs.push(value);
    ys.push(y[index]);
  });
  return line(xs, ys, name, colour, { hovertemplate: "%{y:.4g}", ...extra });
}

/** Return the area between two curves, with one outline for each piece without a gap. */
export function areaWithGaps(x, lower, upper, breaks, name, colour, extra = {}) {
  const edges = [0, ...breaks, x.length], xs = [], ys = [];
  for (let piece = 0; piece + 1 < edges.length; piece += 1) {
    const [first, last] = [edges[piece], edges[piece + 1]];
    if (piece > 0) {
      xs.push(null);
      ys.push(null);
    }
    xs.push(...x.slice(first, last), ...x.slice(first, last).reverse(), x[first]);
    ys.push(...upper.slice(first, last), ...lower.slice(first, last).reverse(), upper[first]);
  }
  return { x: xs, y: ys, name, colour, type: "scatter", mode: "lines", fill: "toself", filled: true, hoverinfo: "skip", line: { width: 0 }, ...extra };
}

/** Return the columns of a mean and its 95 % interval, for files. */
export function intervalColumns(name, mean, std) {
  const end = (side) => mean.map((value, index) => value + side * Z95 * std[index]);
  return { [name]: mean, [`${name}, low`]: end(-1), [`${name}, high`]: end(1) };
}

/** Return the area of the 95 % interval around a mean. */
export function intervalArea(x, mean, std, breaks, name, colour, extra) {
  const lower = mean.map((value, index) => value - Z95 * std[index]);
  const upper = mean.map((value, index) => value + Z95 * std[index]);
  return areaWithGaps(x, lower, upper, breaks, name, colour, extra);
}
