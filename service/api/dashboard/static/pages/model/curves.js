// Torques along a recording as traces of Plotly: lines with gaps between episodes, and their intervals.

import { line } from "../../plots.js";

/** Half-width of a Gaussian's 95 % interval, in standard deviations. */
export const Z95 = 1.959963984540054;

/** Return the standard deviation of a measurement: uncertainty of the model and noise, times the version's scale. */
export function measurementStd(trace, joint) {
  const noise = trace.noise_std[joint], scale = trace.scale[joint];
  return trace.std.map((row) => scale * Math.hypot(row[joint], noise));
}

/** Return the values of a joint. */
export function column(rows, joint) {
  return rows.map((row) => row[joint]);
}

/** Return the horizontal axis of a trace: time since the origin, or row numbers if the time of an episode starts again. */
export function axis(trace, origin) {
  const rising = trace.t.every((value, index) => index === 0 || value >= trace.t[index - 1]);
  return rising ? { x: trace.t.map((each) => each - origin), suffix: " s" } : { x: trace.rows, suffix: "" };
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
