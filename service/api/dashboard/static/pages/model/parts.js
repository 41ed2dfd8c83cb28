// What the torque is made of, and the friction that was learnt: known to the model only, as no sensor measures them.

import { post } from "../../api.js";
import { h, replace } from "../../dom.js";
import { number, shortNames } from "../../format.js";
import { card, loading, table } from "../../ui.js";
import { noData } from "./choice.js";
import { around, broken, column } from "./curves.js";
import { flattery } from "./flattery.js";
import { joints } from "./joints.js";

const POINTS = 500;
const SAID = { gravity: "gravity", inertial: "inertial, M(q) ddq", coriolis: "Coriolis and centrifugal", friction: "friction" };

/** The tab of components along the chosen recording, and of parameters. */
export async function parts(view, state, { signal }) {
  const cards = [frictionCard(state.version), bodiesCard(state.version)];
  if (state.dataset === null) {
    replace(view, noData(state), cards);
    return;
  }
  const request = { dataset: state.dataset, version: state.version.version, part: state.part };
  replace(view, loading("Taking the torque apart"));
  const { offered } = await post(`${state.where}/trace`, { ...request, points: 1 }, signal);
  const fetch = async (start, stop) => {
    const range = stop === null ? {} : { start, stop };
    const trace = await post(`${state.where}/trace`, { ...request, ...range, points: POINTS, components: offered }, signal);
    return { ...trace, joint_types: state.version.joint_types };
  };
  const trace = await fetch(0, null);
  const along = h("div", {});
  const only = offered.length > 1 ? null : h("p", { class: "hint" }, `The estimator ${state.version.estimator} tells friction from the rest, and no more. For gravity, inertia and Coriolis train rigid-body or lip-chain.`);
  replace(view, flattery(trace), card("Parts of the torque", only, along), cards);
  const names = Object.keys(SAID).filter((name) => offered.includes(name));
  const views = names.length > 1 ? { "all parts": (...given) => names.flatMap((name, index) => part(name, index, ...given)) } : {};
  for (const [index, name] of names.entries()) views[SAID[name]] = (...given) => part(name, index, ...given);
  const note = "No sensor measures these parts, so nobody can check their bands: they are the model’s own 95 % intervals.";
  const sum = names.length > 1 ? " They add up to the predicted torque." : "";
  await joints(along, { first: trace, fetch, views, about: Object.fromEntries(Object.keys(views).map((view_) => [view_, note + sum])), signal });
}

function part(name, index, trace, joint, x) {
  const values = trace.components[name];
  const mean = column(values.mean, joint);
  return [
    around(x, mean, column(values.std, joint), trace.breaks, `${SAID[name]}, 95 % of the function`, `version-${index + 1}`, { showlegend: false }),
    broken(x, mean, trace.breaks, SAID[name], `version-${index + 1}`), // joints’ colours are joints’
  ];
}

function frictionCard({ joint_names: names, joint_types: types, parameters }) {
  const { friction } = parameters;
  const value = (term) => (joint) => {
    const { mean, std } = friction[term];
    const vague = Math.abs(mean[joint]) < 2 * std[joint];
    return [`${number(mean[joint])} ± ${number(std[joint], 2)}`, vague ? h("span", { class: "muted", title: "within two standard deviations of zero" }, " ≈ 0") : null];
  };
  const sliding = types.includes("prismatic") ? " (sliding joints: N·s/m and N)" : "";
  const short = shortNames(names);
  const columns = [
    { label: "Joint", cell: (joint) => short[joint] },
    { label: "Viscous, N·m·s/rad", numeric: true, cell: value("viscous") },
    { label: "Coulomb, N·m", numeric: true, cell: value("coulomb") },
    { label: "Offset, N·m", numeric: true, cell: value("offset") },
    ...(friction.stribeck ? [{ label: "At low speed, N·m", numeric: true, cell: value("stribeck") }] : []),
  ];
  return card(
    "Friction parameters",
    table(columns, names.map((_name, joint) => joint), { caption: `Mean ± one standard deviation${sliding}, as trained` }),
    h("p", { class: "hint" }, "Friction is viscous · dq + Coulomb · sign(dq) + offset; the offset also holds whatever else is constant. ≈ 0: less than two standard deviations from zero, so the data show no such friction. All as trained, without what was learnt online."),
  );
}

function bodiesCard({ joint_names: names, parameters }) {
  const short = shortNames(names);
  const { inertia } = parameters;
  if (!inertia) return null;
  const columns = [
    { label: "Joint that moves the body", cell: (body) => short[names.indexOf(body.joint)] },
    { label: "Mass, kg", numeric: true, cell: (body) => `${number(body.mean.mass)} ± ${number(body.std.mass, 2)}` },
    { label: "Nearest possible mass, kg", numeric: true, cell: (body) => number(body.plausible.mass) },
  ];
  return card(
    "Masses",
    table(columns, inertia.bodies, { caption: "Mean ± one standard deviation, as trained" }),
    h("p", { class: "hint" },
      inertia.mean_is_plausible ? "These masses are physically possible. " : "The means are not physically possible together; the nearest possible masses are. ",
      "Torque depends on sums of masses and rarely on one alone. What it leaves open comes from the prior, so a small ± does not prove that the recording told this mass. Moments and inertias: ", h("code", {}, "parameters"), " of the version in the API."),
  );
}
