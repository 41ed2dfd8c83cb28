// Torques along a recording as Plotly's traces: lines that break between episodes, and bands around them.

import { line } from "../../plots.js";

/** Standard deviations on either side that hold 95 % of a Gaussian. */
export const Z95 = 1.959963984540054;

/** What 95 % intervals are 2 · Z95 of: what is not known of the function, and noise, times the version's scale. */
export function measurementStd(trace, joint) {
  const noise = trace.noise_std[joint], scale = trace.scale[joint];
  return trace.std.map((row) => scale * Math.hypot(row[joint], noise));
}

/** One joint's column of rows. */
export function column(rows, joint) {
  return rows.map((row) => row[joint]);
}

/** What a trace is drawn against: its times, or row numbers where episodes have clocks of their own. */
export function axis(trace) {
  const orderly = trace.t.every((value, index) => index === 0 || value >= trace.t[index - 1]);
  return orderly ? { x: trace.t, suffix: " s" } : { x: trace.rows, suffix: "" };
}

/** A line through values that breaks where the trace breaks. */
export function broken(x, y, breaks, name, colour, extra = {}) {
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

/** The area between two curves, one outline for every unbroken piece. */
export function ribbon(x, lower, upper, breaks, name, colour, extra = {}) {
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

/** A band of so many standard deviations around a mean. */
export function around(x, mean, std, breaks, name, colour, extra) {
  const lower = mean.map((value, index) => value - Z95 * std[index]);
  const upper = mean.map((value, index) => value + Z95 * std[index]);
  return ribbon(x, lower, upper, breaks, name, colour, extra);
}
