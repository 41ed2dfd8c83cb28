// Small drawing of a learnt arm: links, coloured joint axes, masses.

import { jointVar } from "../../colours.js";
import { html, useEffect, useMemo, useRef, useState } from "../../preact.js";
import { add, armPaths, frames, gravityAlignment, scaled, times } from "./kinematics.js";

const AZIMUTH = -0.9, ELEVATION = 0.3; // of the eye, rad
const AXIS = 0.075, PLATE = 0.16, BALL = 0.085; // half-length of an axis, radius of the plate, largest ball: relative to the size of the arm
const ROOM = 0.06;
const GLIDE_MS = 1800;
const REDUCED_MOTION = matchMedia("(prefers-reduced-motion: reduce)");

/** An arm {gravity, joints} of `/v1/overview` at positions q. It glides to new positions; `key` is the version. label: for screen readers. */
export function Sketch({ arm, q, label }) {
  const shape = useMemo(() => shapeOf(arm), []);
  const { size, most } = shape;
  const { links, centres, axes } = pose(shape, useGliding(q));
  const plate = circle(PLATE * size).map(project);
  const view = useView(size, [...links.flat(), ...centres, ...plate]);
  const ball = ({ mass }) => BALL * size * Math.cbrt(Math.max(mass, 0) / most);
  return html`<svg class="arm-sketch" role="img" aria-label=${label} viewBox=${view}>
    <path class="plate" d=${`${path(plate)}Z`} />
    <path class="links-edge" stroke-width=${0.075 * size} d=${links.map(path).join("")} />
    <path class="links" stroke-width=${0.055 * size} d=${links.map(path).join("")} />
    ${shape.joints.map((each, place) => html`<circle class="mass" r=${ball(each)} cx=${centres[place][0]} cy=${centres[place][1]} />`)}
    ${shape.joints.map((each, place) => html`<path class="axis" stroke=${jointVar(each.joint)} stroke-width=${0.036 * size} d=${path(axes[place])} />`)}
  </svg>`;
}

/** Joints in a row, for estimators that do not learn an arm. */
export function Chain({ n, label }) {
  const spot = (joint) => [12 + (76 * joint) / Math.max(n - 1, 1), 50 - 16 * Math.sin((2.4 * joint) / Math.max(n - 1, 1))];
  const spots = Array.from({ length: n }, (_, joint) => spot(joint));
  return html`<svg class="arm-sketch" role="img" aria-label=${label} viewBox="0 0 100 80">
    <path class="links unknown" stroke-width="2" d=${path(spots)} />
    ${spots.map(([x, y], joint) => html`<circle cx=${x} cy=${y} r="4.2" fill=${jointVar(joint)} />`)}
  </svg>`;
}

/** Return positions that follow q within GLIDE_MS; at once if reduced motion is set. */
function useGliding(q) {
  const [shown, setShown] = useState(q);
  const last = useRef(q);
  useEffect(() => {
    const from = last.current, began = performance.now();
    let frame = 0;
    const show = (positions) => setShown((last.current = positions));
    const step = (now) => {
      const share = Math.min(Math.max(now - began, 0) / GLIDE_MS, 1);
      show(from.map((start, joint) => start + share * (q[joint] - start)));
      if (share < 1) frame = requestAnimationFrame(step);
    };
    if (REDUCED_MOTION.matches || from.length !== q.length) show(q);
    else if (from.some((each, joint) => each !== q[joint])) frame = requestAnimationFrame(step);
    return () => cancelAnimationFrame(frame);
  }, [JSON.stringify(q)]);
  return shown.length === q.length ? shown : q;
}

/** Return the view box around all points so far: it only grows, so that a moving arm keeps its size. */
function useView(size, points) {
  const box = useRef({ low: [Infinity, Infinity], high: [-Infinity, -Infinity] }).current;
  const room = (ROOM + BALL) * size;
  for (const point of points) {
    box.low = box.low.map((low, k) => Math.min(low, point[k]));
    box.high = box.high.map((high, k) => Math.max(high, point[k]));
  }
  return [...box.low.map((low) => low - room), ...box.high.map((high, k) => high - box.low[k] + 2 * room)].join(" ");
}

function shapeOf({ gravity, joints }) {
  const size = Math.max(joints.reduce((sum, each) => sum + Math.hypot(...each.translation), 0), 0.05);
  return { joints, size, up: gravityAlignment(gravity), most: Math.max(...joints.map((each) => each.mass)) };
}

/** Return the projected points of an arm at positions q. */
function pose({ joints, size, up }, q) {
  const turned = frames({ order: joints.map((each) => each.joint), joints }, q).map(({ rotation, origin, axis }) => ({
    origin: times(up, origin), axis: times(up, axis), out: (vector) => times(up, times(rotation, vector)),
  }));
  const centres = turned.map(({ origin, out }, place) => add(origin, out(joints[place].centre)));
  const ends = ({ origin, axis }) => [-AXIS * size, AXIS * size].map((length) => project(add(origin, scaled(axis, length))));
  return {
    links: armPaths(joints, turned.map((each) => each.origin), centres).map((each) => each.map(project)),
    centres: centres.map(project),
    axes: turned.map(ends),
  };
}

/** Project a point: right, and down. */
function project([x, y, z]) {
  const across = Math.cos(AZIMUTH) * x + Math.sin(AZIMUTH) * y;
  const away = -Math.sin(AZIMUTH) * x + Math.cos(AZIMUTH) * y;
  return [across, -(Math.cos(ELEVATION) * z + Math.sin(ELEVATION) * away)];
}

function circle(radius) {
  return Array.from({ length: 32 }, (_, corner) => [radius * Math.cos((Math.PI * corner) / 16), radius * Math.sin((Math.PI * corner) / 16), 0]);
}

function path(points) {
  return points.map(([x, y], index) => `${index ? "L" : "M"}${x.toFixed(4)} ${y.toFixed(4)}`).join("");
}
