// Small charts for cards and tables: a bar per joint, innovations of the last hour. Each joint has its colour.

import { jointVar } from "./colours.js";
import { h } from "./dom.js";
import { nmse, number, percent } from "./format.js";

const MIN_NMSE = 1e-6; // bottom of the scale; its top is 1, the error of the mean torque
const MIN_COVERAGE = 0.8; // bottom of the scale
const NOMINAL_COVERAGE = 0.95;
const MIN_BAR_HEIGHT = 0.04; // of the chart's height

/**
 * Return bars of the nMSE of each joint on a logarithmic scale. names: of the joints; values: null if unknown;
 * marks: a second value of each joint, drawn as a line.
 */
export function errorBars(names, values, { marks = null, what = "nMSE" } = {}) {
  const share = (value) => Math.min(Math.max(1 - Math.log10(value) / Math.log10(MIN_NMSE), MIN_BAR_HEIGHT), 1);
  const columns = names.map((name, joint) => {
    const [value, mark] = [values?.[joint], marks?.[joint]];
    return column(joint, isKnown(value) ? [0, share(value)] : null, isKnown(mark) ? share(mark) : null, `${name}: ${barTitle(value, mark, nmse)}`);
  });
  return bars("nmse", columns, `${what} by joint: ${describeValues(names, values ?? marks, nmse)}`, [[share(1e-4), ""], [share(1e-2), ""]]);
}

/** Return bars of the coverage of each joint: from 95 % upwards if its intervals are too wide, downwards if too narrow. */
export function coverageBars(names, values, { marks = null, what = "Coverage of the 95 % interval" } = {}) {
  const share = (value) => Math.min(Math.max((value - MIN_COVERAGE) / (1 - MIN_COVERAGE), 0), 1);
  const nominal = share(NOMINAL_COVERAGE);
  const span = (value) => {
    const ends = [share(value), nominal].sort((a, b) => a - b);
    return ends[1] - ends[0] < MIN_BAR_HEIGHT ? [nominal - MIN_BAR_HEIGHT / 2, nominal + MIN_BAR_HEIGHT / 2] : ends;
  };
  const columns = names.map((name, joint) => {
    const [value, mark] = [values?.[joint], marks?.[joint]];
    return column(joint, isKnown(value) ? span(value) : null, isKnown(mark) ? share(mark) : null, `${name}: ${barTitle(value, mark, percent)}`);
  });
  return bars("coverage", columns, `${what} by joint: ${describeValues(names, values ?? marks, percent)}`, [[nominal, "nominal"]]);
}

/** Return both charts, each below its name and the mean of the joints. shown, recent: {nmse, coverage}; recent may be null. */
export function qualityCharts(names, shown, recent = null) {
  const chart = (label, value, made) => h("div", {}, h("div", { class: "chart-label" }, h("span", {}, label), h("strong", {}, value)), made);
  return [
    chart("Error, nMSE", nmse(mean(shown.nmse)), errorBars(names, shown.nmse, { marks: recent?.nmse })),
    chart("95\u00a0% coverage", percent(mean(shown.coverage), 0), coverageBars(names, shown.coverage, { marks: recent?.coverage })),
  ];
}

/**
 * Plot the innovations of the last `seconds`, one line per joint. course: [{at, innovation}], oldest first; now: Unix s;
 * bucket: length of a point, s. The dashed line is at one standard deviation.
 */
export function innovationCourse(names, course, seconds, now, bucket) {
  const most = Math.max(4, ...course.flatMap((point) => point.innovation));
  const x = (at) => Math.min(Math.max(100 * (1 - (now - at) / seconds), 0), 100);
  const y = (value) => 40 * (1 - Math.sqrt(Math.min(value, most) / most));
  const lines = names.map((_name, joint) => {
    let last = -Infinity;
    const d = course.map(({ at, innovation }) => {
      const joined = at - last < 1.5 * bucket;
      last = at;
      return `${joined ? "L" : "M"}${x(at).toFixed(2)} ${y(innovation[joint]).toFixed(2)}H${x(at + bucket).toFixed(2)}`;
    });
    return h("path", { d: d.join(""), stroke: jointVar(joint) });
  });
  const worst = names.map((_name, joint) => Math.max(...course.map((point) => point.innovation[joint])));
  const joint = worst.indexOf(Math.max(...worst));
  const label = `Innovation of the last hour in standard deviations; largest: ${number(worst[joint], 2)} on ${names[joint]}`;
  return h(
    "svg",
    { class: "course", role: "img", "aria-label": label, viewBox: "0 0 100 40", preserveAspectRatio: "none" },
    h("title", {}, label),
    h("line", { class: "one", x1: "0", x2: "100", y1: y(1), y2: y(1) }),
    lines,
  );
}

/** Plot errors against rows, both on logarithmic scales that start at the smallest value. */
export function errorCurve(rows, errors) {
  const [x, y] = [scale(rows, 1, 99), scale(errors, 39, 1)];
  const label = `nMSE against rows: ${rows.map((each, index) => `${nmse(errors[index])} with ${each}`).join(", ")}`;
  return h(
    "svg",
    { class: "course", role: "img", "aria-label": label, viewBox: "0 0 100 40", preserveAspectRatio: "none" },
    h("title", {}, label),
    h("path", { d: `M${rows.map((each, index) => `${x(each).toFixed(2)} ${y(errors[index]).toFixed(2)}`).join("L")}`, stroke: jointVar(0) }),
  );
}

/** Return the map of values, on a logarithmic scale, to a range of numbers; its middle if all are equal. */
function scale(values, first, last) {
  const [low, high] = [Math.log(Math.min(...values)), Math.log(Math.max(...values))];
  return (value) => (high > low ? first + ((last - first) * (Math.log(value) - low)) / (high - low) : (first + last) / 2);
}

/** Return the mean of the known values; null if there are none. */
export function mean(values) {
  const there = (values ?? []).filter(isKnown);
  return there.length ? there.reduce((sum, each) => sum + each, 0) / there.length : null;
}

function bars(kind, columns, label, rules) {
  return h(
    "div",
    { class: `bars ${kind}`, role: "img", "aria-label": label },
    rules.map(([height, name]) => h("i", { class: `rule ${name}`, style: `bottom: ${(100 * height).toFixed(1)}%` })),
    columns,
  );
}

function column(joint, span, mark, title) {
  const bar = span ? h("b", { style: `bottom: ${(100 * span[0]).toFixed(1)}%; height: ${(100 * (span[1] - span[0])).toFixed(1)}%; background: ${jointVar(joint)}` }) : null;
  const line = mark === null ? null : h("u", { style: `bottom: ${(100 * mark).toFixed(1)}%` });
  return h("span", { title }, bar, line);
}

function barTitle(value, mark, format) {
  if (!isKnown(mark)) return format(value);
  return isKnown(value) ? `${format(value)} held out, ${format(mark)} in the last hour` : `${format(mark)} in the last hour`;
}

function describeValues(names, values, format) {
  return names.map((name, joint) => `${name} ${format(values?.[joint])}`).join(", ");
}

function isKnown(value) {
  return value !== null && value !== undefined && Number.isFinite(value);
}
