// Small charts of the joints for cards: bars of the errors, lines of the innovation. Each joint has its colour.

import { jointVar } from "./colours.js";
import { number, shortNames } from "./format.js";
import { html } from "./preact.js";

const MIN_BAR = 0.03; // of the chart's height
const BUCKETS = 60; // points of a course
const MIN_RANGE_STD = 4;

/** Bars of the RMSE of each joint below the largest one. joints: those of a verdict; bars: shares of the torque's range, else N·m. */
export function ErrorBars({ joints }) {
  const names = shortNames(joints.map((each) => each.joint));
  const inRange = joints.every((each) => each.range_share !== null);
  const size = (each) => (inRange ? each.range_share : each.rmse);
  const most = Math.max(...joints.map(size)), worst = joints.findIndex((each) => size(each) === most);
  const told = joints.map((each, joint) => `${names[joint]} ${rmse(each)}${inRange ? `, ${share(each.range_share)}` : ""}`);
  const bar = (each, joint) => html`<span title=${told[joint]}><b style=${{ height: `${100 * Math.max(size(each) / most || 0, MIN_BAR)}%`, background: jointVar(joint) }} /></span>`;
  return html`<div>
    <div class="chart-label"><span>RMSE${inRange ? ", share of range" : ""}</span></div>
    <div class="bars rmse" role="img" aria-label=${`RMSE${inRange ? " and its share of the range of the torque" : ""} by joint: ${told.join("; ")}`}>${joints.map(bar)}</div>
    <p class="chart-label most"><span>largest: ${names[worst]}</span> <strong>${rmse(joints[worst])}${inRange && html`, ${share(most)}`}</strong></p>
  </div>`;
}

/** Lines of the innovation of each joint in the last `seconds`, in standard deviations. course: [{at, innovation}], oldest first. */
export function Course({ names, course, seconds }) {
  const now = Math.max(Date.now() / 1000, course.at(-1).at), bucket = Math.max(seconds / BUCKETS, 1);
  const worst = names.map((_name, joint) => Math.max(...course.map((point) => point.innovation[joint])));
  const most = Math.max(...worst), top = Math.max(MIN_RANGE_STD, most), joint = worst.indexOf(most);
  const x = (at) => Math.min(Math.max(100 * (1 - (now - at) / seconds), 0), 100).toFixed(2);
  const y = (value) => (40 * (1 - Math.sqrt(Math.min(value, top) / top))).toFixed(2);
  const isJoined = (index) => index > 0 && course[index].at - course[index - 1].at < 1.5 * bucket;
  const line = (of) => course.map(({ at, innovation }, index) => `${isJoined(index) ? "L" : "M"}${x(at)} ${y(innovation[of])}H${x(at + bucket)}`).join("");
  const label = `Innovation of the last hour in standard deviations; largest: ${number(most, 2)} on ${names[joint]}`;
  return html`<div>
    <div class="chart-label"><span>Innovation, last hour</span> <strong>up to ${number(most, 2)} σ, ${names[joint]}</strong></div>
    <svg class="course" role="img" aria-label=${label} viewBox="0 0 100 40" preserveAspectRatio="none">
      <title>${label}; dashed: 1 σ</title>
      <line class="one" x1="0" x2="100" y1=${y(1)} y2=${y(1)} />
      ${names.map((_name, of) => html`<path d=${line(of)} stroke=${jointVar(of)} />`)}
    </svg>
  </div>`;
}

function share(value) {
  return `${number(100 * value, 2)}\u00a0%`;
}

function rmse({ rmse: value, unit }) {
  return `${number(value, 2)}\u00a0${unit}`;
}
