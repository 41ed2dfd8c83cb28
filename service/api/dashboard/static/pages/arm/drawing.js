// 3-D drawing of a learnt arm: links, joint axes, masses and their uncertainties.

import { css, withOpacity, jointColour } from "../../colours.js";
import { shortNames } from "../../format.js";
import { escapeMarkup, plot } from "../../plots.js";
import { acrossPlane, cameraFor } from "./camera.js";
import { add, armPaths, frames, gravityAlignment, massCentres, scaled, times } from "./kinematics.js";

const AXIS = 0.12; // half-length of an axis, relative to the size of the arm
const ROUND = 24; // vertices of a disc
const MARGIN = 0.05;
const HIGHLIGHT_PX = 20; // width of the highlighted axis
const MIN_MASS_PX = 7, MAX_MASS_PX = 24;

/** Notes beside the drawing. */
export const AMBIGUITY_NOTE = "Torque does not distinguish an arm from its mirror image, and does not determine the position of a frame along its axis.";
export const LEGEND = "Coloured lines: joint axes. Grey lines: links. Balls: centres of mass. Discs and thin lines: standard deviation of the position and direction of an axis, relative to the previous joint. Pale discs and hollow balls: unidentifiable.";

/** Return whether the browser supports 3-D drawing. */
export function drawable() {
  return document.createElement("canvas").getContext("webgl") !== null;
}

/** Draw the arm of a version at positions q into an element. Returns {draw(q, joint)}, which moves it; joint: highlighted axis. */
export async function drawing(element, { joint_names: names, parameters, training_range: range }, q, { height = 460, legend = true, signal }) {
  const arm = new Arm(names, parameters, range);
  const label = `The arm in 3-D, ${names.length} joints from base to tip: ${arm.names.join(", ")}. The tables contain the same values.`;
  let last = q;
  const layout = () => arm.layout(height, element.clientWidth / height, legend);
  const first = arm.at(last);
  const made = await plot(element, arm.traces(first), layout(), { label, signal });
  const draw = (positions, thick = arm.thick) => {
    last = positions;
    arm.thick = thick;
    const shown = arm.at(last);
    return made.react(arm.traces(shown), layout());
  };
  const again = () => (element.isConnected ? draw(last) : null);
  document.addEventListener("themechange", again);
  let width = element.clientWidth; // the distance of the camera depends on it
  const sized = new ResizeObserver(() => {
    if (element.clientWidth && element.clientWidth !== width) again();
    width = element.clientWidth;
  });
  sized.observe(element);
  signal?.addEventListener("abort", () => {
    sized.disconnect();
    document.removeEventListener("themechange", again);
  });
  return { draw };
}

class Arm {
  constructor(names, { geometry, inertia }, range) {
    const short = shortNames(names);
    const masses = inertia.bodies.map((body) => body.plausible.mass);
    Object.assign(this, { geometry, bodies: inertia.bodies, masses, centres: massCentres(inertia), up: gravityAlignment(geometry.gravity) });
    this.names = geometry.order.map((joint) => short[joint]);
    const slide = ({ type }, place) => (type === "prismatic" ? Math.max(...["min", "max"].map((end) => Math.abs(range.q[end][geometry.order[place]]))) : 0);
    const steps = geometry.joints.map((joint, place) => Math.hypot(...joint.translation) + slide(joint, place));
    this.size = Math.max(steps.reduce((all, each) => all + each, 0), ...this.centres.map((each) => Math.hypot(...each)), 0.05);
    this.reach = [[0, 0, 0], [0, 0, 0]];
    this.thick = null;
    this.eye = null;
  }

  /** Return all points of the drawing, with gravity downwards. */
  at(q) {
    const turned = frames(this.geometry, q).map(({ rotation, origin, axis }) => ({
      origin: times(this.up, origin),
      axis: times(this.up, axis),
      out: (vector) => times(this.up, times(rotation, vector)),
    }));
    const masses = turned.map(({ origin, out }, place) => add(origin, out(this.centres[this.geometry.order[place]])));
    for (const point of [...turned.map((each) => each.origin), ...masses]) {
      this.reach = [this.reach[0].map((low, k) => Math.min(low, point[k])), this.reach[1].map((high, k) => Math.max(high, point[k]))];
    }
    this.eye ??= acrossPlane([[0, 0, 0], ...turned.map((each) => each.origin)]); // it stays while the arm moves
    return { turned, masses };
  }

  traces({ turned, masses }) {
    const { order } = this.geometry;
    const links = armPaths(this.geometry.joints, turned.map((each) => each.origin)).flatMap((each) => [...each, null]).slice(0, -1);
    const arms = turned.flatMap(({ origin }, place) => [origin, masses[place], null]);
    const half = AXIS * this.size;
    const balls = order.map((joint) => this.masses[joint]);
    const most = Math.max(...balls);
    const open = (joint) => this.bodies[joint].undetermined?.includes("mass");
    return [
      path(links, { name: "links", line: { color: css("line-strong"), width: 12 }, hoverinfo: "skip", connectgaps: false }),
      path(arms, { name: "to the masses", line: { color: css("muted"), width: 2 }, hoverinfo: "skip", connectgaps: false }),
      ...turned.map(({ origin, axis }, place) => path([add(origin, scaled(axis, -half)), add(origin, scaled(axis, half))], {
        name: this.names[place], line: { color: jointColour(order[place]), width: order[place] === this.thick ? HIGHLIGHT_PX : 9 }, hovertemplate: `${escapeMarkup(this.names[place])}, ${this.geometry.joints[place].type}<extra></extra>`,
      })),
      {
        ...points(masses), type: "scatter3d", mode: "markers", name: "masses", showlegend: false,
        text: order.map((joint, place) => `${this.names[place]} moves ${this.masses[joint].toPrecision(3)} kg${open(joint) ? " (unidentifiable)" : ""}`),
        hovertemplate: "%{text}<extra></extra>",
        marker: {
          size: balls.map((mass) => Math.max(MAX_MASS_PX * Math.cbrt(mass / most), MIN_MASS_PX)),
          symbol: order.map((joint) => (open(joint) ? "circle-open" : "circle")), color: css("accent"), opacity: 0.7, line: { width: 0 },
        },
      },
      this.#pointing(turned, half),
      ...[false, true].map((pale) => this.#discs(turned, pale)),
    ];
  }

  /** Return the layout. height: px; ratio: width / height; labels: of the axes. */
  layout(height, ratio, labels) {
    const span = [0, 1, 2].map((k) => this.reach[1][k] - this.reach[0][k]);
    const room = Math.max(MARGIN * Math.max(...span), AXIS * this.size);
    const lengths = span.map((each) => each + 2 * room), longest = Math.max(...lengths);
    const sides = lengths.map((each) => each / longest), [x, y, z] = sides; // true proportions
    const axis = (k) => ({
      range: [this.reach[0][k] - room, this.reach[1][k] + room], title: { text: labels ? "xyz"[k] + " m" : "" }, showticklabels: labels, color: css("muted"), gridcolor: css("line"),
      zerolinecolor: css("line-strong"), showbackground: false, showspikes: false, nticks: 5,
    });
    return {
      height, hovermode: "closest", showlegend: false, margin: { l: 0, r: 0, t: 0, b: 0 }, uirevision: "arm",
      scene: { aspectmode: "manual", aspectratio: { x, y, z }, uirevision: "arm", xaxis: axis(0), yaxis: axis(1), zaxis: axis(2), camera: cameraFor(this.eye, sides, ratio, labels) },
    };
  }

  /** Return the axes rotated by plus and minus one standard deviation. */
  #pointing(turned, half) {
    const ends = turned.flatMap(({ origin, out }, place) => {
      const { axis, across, turn_std: std } = this.geometry.joints[place];
      return std.flatMap((angle, k) => [-1, 1].flatMap((side) => {
        // a rotation about one of the two vectors moves the axis along the other
        const moved = add(axis, scaled(cross(across[k], axis), side * Math.tan(Math.min(angle, 1.2))));
        const end = out(scaled(moved, half / Math.hypot(...moved)));
        return [add(origin, scaled(end, -1)), add(origin, end), null];
      }));
    });
    return path(ends, { name: "± std of the axes", showlegend: false, line: { color: withOpacity(css("text"), 0.3), width: 2 }, hoverinfo: "skip", connectgaps: false });
  }

  /** Return discs of one standard deviation of the position across the axes; pale: those of the unidentifiable axes. */
  #discs(turned, pale) {
    const corners = [], triangles = [];
    turned.forEach(({ origin, out }, place) => {
      const { across, shift_std: std, undetermined } = this.geometry.joints[place];
      if (!std.length || undetermined.some((each) => each.startsWith("shift")) !== pale) return;
      const middle = corners.push(origin) - 1;
      for (let corner = 0; corner < ROUND; corner += 1) {
        const angle = (2 * Math.PI * corner) / ROUND;
        const radii = std.map((each) => Math.min(each, this.size));
        corners.push(add(origin, out(add(scaled(across[0], radii[0] * Math.cos(angle)), scaled(across[1], radii[1] * Math.sin(angle))))));
        triangles.push([middle, middle + 1 + corner, middle + 1 + ((corner + 1) % ROUND)]);
      }
    });
    const [i, j, k] = [0, 1, 2].map((corner) => triangles.map((each) => each[corner]));
    return {
      ...points(corners), i, j, k, type: "mesh3d", name: "± std of the positions", showlegend: false, hoverinfo: "skip", color: css("novel"), opacity: pale ? 0.12 : 0.45, flatshading: true,
      lighting: { ambient: 1, diffuse: 0, specular: 0 },
    };
  }
}

function path(list, extra) {
  return { ...points(list), type: "scatter3d", mode: "lines", showlegend: false, ...extra, ...(extra.hovertemplate ? { showlegend: true } : {}) };
}

function points(list) {
  const [x, y, z] = [0, 1, 2].map((k) => list.map((point) => (point === null ? null : point[k])));
  return { x, y, z };
}

function cross([a, b, c], [x, y, z]) {
  return [b * z - c * y, c * x - a * z, a * y - b * x];
}
