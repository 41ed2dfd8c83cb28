// Small drawing of a learnt arm: links, coloured joint axes, masses.

import { jointVar } from "../../colours.js";
import { h } from "../../dom.js";
import { add, frames, gravityAlignment, scaled, times } from "./kinematics.js";

const AZIMUTH = -0.9, ELEVATION = 0.3; // of the eye, rad
const AXIS = 0.075, PLATE = 0.16, BALL = 0.085; // half-length of an axis, radius of the plate, largest ball: relative to the size of the arm
const ROOM = 0.06;
const GLIDE_MS = 1800;
const REDUCED_MOTION = matchMedia("(prefers-reduced-motion: reduce)");

/**
 * Draw an arm {gravity, joints} of `/v1/overview` at positions q. label: for screen readers.
 * Returns {element, pose(q), glide(q)}: `pose` moves the arm at once, `glide` with an animation unless reduced motion is set.
 */
export function sketch(arm, q, label) {
  const geometry = { order: arm.joints.map((each) => each.joint), joints: arm.joints };
  const up = gravityAlignment(arm.gravity);
  const size = Math.max(arm.joints.reduce((sum, each) => sum + Math.hypot(...each.translation), 0), 0.05);
  const most = Math.max(...arm.joints.map((each) => each.mass));
  const stroke = (factor) => String(factor * size);
  const plate = h("path", { class: "plate" });
  const back = h("path", { class: "links-edge", "stroke-width": stroke(0.075) });
  const links = h("path", { class: "links", "stroke-width": stroke(0.055) });
  const masses = arm.joints.map((each) => h("circle", { class: "mass", r: stroke(BALL * Math.cbrt(Math.max(each.mass, 0) / most)) }));
  const axes = arm.joints.map((each) => h("path", { class: "axis", stroke: jointVar(each.joint), "stroke-width": stroke(0.036) }));
  const element = h("svg", { class: "arm-sketch", role: "img", "aria-label": label }, plate, back, links, masses, axes);
  const seen = { low: [Infinity, Infinity], high: [-Infinity, -Infinity] };
  let shown = q, frame = 0;

  const pose = (positions) => {
    shown = positions;
    const turned = frames(geometry, positions).map(({ rotation, origin, axis }) => ({
      origin: times(up, origin), axis: times(up, axis), out: (vector) => times(up, times(rotation, vector)),
    }));
    const centres = turned.map(({ origin, out }, place) => add(origin, out(arm.joints[place].centre)));
    const chain = [[0, 0, 0], ...turned.map((each) => each.origin), centres.at(-1)].map(project);
    back.setAttribute("d", path(chain));
    links.setAttribute("d", path(chain));
    plate.setAttribute("d", `${path(circle(PLATE * size).map(project))}Z`);
    centres.map(project).forEach(([x, y], place) => {
      masses[place].setAttribute("cx", x);
      masses[place].setAttribute("cy", y);
    });
    const half = AXIS * size;
    turned.forEach(({ origin, axis }, place) => {
      axes[place].setAttribute("d", path([-half, half].map((length) => project(add(origin, scaled(axis, length))))));
    });
    fitView([...chain, ...centres.map(project), ...circle(PLATE * size).map(project)]);
  };
  // the view only grows, so that a moving arm does not change its size
  const fitView = (points) => {
    for (const point of points) {
      seen.low = seen.low.map((low, k) => Math.min(low, point[k]));
      seen.high = seen.high.map((high, k) => Math.max(high, point[k]));
    }
    const room = ROOM * size + BALL * size;
    const [x, y] = seen.low.map((low) => low - room);
    const [width, height] = seen.high.map((high, k) => high + room - seen.low[k] + room);
    element.setAttribute("viewBox", `${x} ${y} ${width} ${height}`);
  };
  const glide = (positions) => {
    cancelAnimationFrame(frame);
    if (REDUCED_MOTION.matches || !element.isConnected) return void pose(positions);
    const from = shown;
    const began = performance.now();
    const step = (now) => {
      const share = Math.min((now - began) / GLIDE_MS, 1);
      pose(from.map((start, joint) => start + share * (positions[joint] - start)));
      if (share < 1 && element.isConnected) frame = requestAnimationFrame(step);
    };
    frame = requestAnimationFrame(step);
  };
  pose(q);
  return { element, pose, glide };
}

/** Draw joints in a row, for estimators that do not learn an arm. */
export function chain(n, label) {
  const spot = (joint) => [12 + (76 * joint) / Math.max(n - 1, 1), 50 - 16 * Math.sin((2.4 * joint) / Math.max(n - 1, 1))];
  const spots = Array.from({ length: n }, (_, joint) => spot(joint));
  return h(
    "svg",
    { class: "arm-sketch", role: "img", "aria-label": label, viewBox: "0 0 100 80" },
    h("path", { class: "links unknown", "stroke-width": "2", d: path(spots) }),
    spots.map(([x, y], joint) => h("circle", { cx: x, cy: y, r: "4.2", fill: jointVar(joint) })),
  );
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
