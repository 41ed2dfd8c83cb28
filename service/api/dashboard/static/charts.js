// Small charts that stand in cards and tables: bars per joint, a course of the last hour. Joints have their colours.

import { jointVar } from "./colours.js";
import { h } from "./dom.js";
import { nmse, number, percent } from "./format.js";

const BEST = 1e-6; // nMSE at the bottom of its scale; 1, no better than the mean, is the top
const NARROW = 0.8; // coverage at the bottom of its scale
const PROMISED = 0.95;
const LEAST = 0.04; // height of a bar that there is

/**
 * nMSE of each joint as bars on a logarithmic scale. names: of the joints; values: null where not known; marks: a second value of each, drawn as a line.
 */
export function errorBars(names, values, { marks = null, what = "nMSE" } = {}) {
  const share = (value) => Math.min(Math.max(1 - Math.log10(value) / Math.log10(BEST), LEAST), 1);
  const columns = names.map((name, joint) => {
    const [value, mark] = [values?.[joint], marks?.[joint]];
    return column(joint, known(value) ? [0, share(value)] : null, known(mark) ? share(mark) : null, `${name}: ${texts(value, mark, nmse)}`);
  });
  return bars("nmse", columns, `${what} by joint: ${listed(names, values ?? marks, nmse)}`, [[share(1e-4), ""], [share(1e-2), ""]]);
}

/** Coverage of the 95 % band of each joint: bars from what is promised, up where bands are wide, down where they are narrow. */
export function coverageBars(names, values, { marks = null, what = "Inside the 95 % band" } = {}) {
  const share = (value) => Math.min(Math.max((value - NARROW) / (1 - NARROW), 0), 1);
  const promised = share(PROMISED);
  const span = (value) => {
    const ends = [share(value), promised].sort((a, b) => a - b);
    return ends[1] - ends[0] < LEAST ? [promised - LEAST / 2, promised + LEAST / 2] : ends;
  };
  const columns = names.map((name, joint) => {
    const [value, mark] = [values?.[joint], marks?.[joint]];
    return column(joint, known(value) ? span(value) : null, known(mark) ? share(mark) : null, `${name}: ${texts(value, mark, percent)}`);
  });
  return bars("coverage", columns, `${what} by joint: ${listed(names, values ?? marks, percent)}`, [[promised, "promised"]]);
}

/** Both of these charts, each below its name and the mean of the joints. shown, lately: {nmse, coverage}; lately may be null. */
export function qualityCharts(names, shown, lately = null) {
  const chart = (label, value, made) => h("div", {}, h("div", { class: "chart-label" }, h("span", {}, label), h("strong", {}, value)), made);
  return [
    chart("Error, nMSE", nmse(mean(shown.nmse)), errorBars(names, shown.nmse, { marks: lately?.nmse })),
    chart("In the 95\u00a0% band", percent(mean(shown.coverage), 0), coverageBars(names, shown.coverage, { marks: lately?.coverage })),
  ];
}

/**
 * How large innovations were along the last `seconds`, a line a joint; course: [{at, innovation}], oldest first; now: Unix s.
 * The dashed line is where errors are as large as the model says.
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
  const label = `Innovation of the last hour in standard deviations; the largest, ${number(worst[joint], 2)}, of ${names[joint]}`;
  return h(
    "svg",
    { class: "course", role: "img", "aria-label": label, viewBox: "0 0 100 40", preserveAspectRatio: "none" },
    h("title", {}, label),
    h("line", { class: "one", x1: "0", x2: "100", y1: y(1), y2: y(1) }),
    lines,
  );
}

/** Mean of the joints that have a value; null where none has. */
export function mean(values) {
  const there = (values ?? []).filter(known);
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

function texts(value, mark, format) {
  if (!known(mark)) return format(value);
  return known(value) ? `${format(value)} held out, ${format(mark)} lately` : `${format(mark)} lately`;
}

function listed(names, values, format) {
  return names.map((name, joint) => `${name} ${format(values?.[joint])}`).join(", ");
}

function known(value) {
  return value !== null && value !== undefined && Number.isFinite(value);
}
