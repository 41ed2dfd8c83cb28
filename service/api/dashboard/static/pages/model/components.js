// Components of a torque: which an estimator offers, their names and colours.

const NAMES = { inertial: "inertial, M(q) ddq", coriolis: "Coriolis and centrifugal", gravity: "gravity", friction: "friction" };

/** Return the components that an estimator offers: all if it learns energies or rigid bodies, else friction. */
export function offered({ estimator }) {
  return /^(lip|rigid-body)/.test(estimator) ? Object.keys(NAMES) : ["friction"];
}

/** Return the label of a component. */
export function componentLabel(name) {
  return NAMES[name] ?? "all else";
}

/** Return the CSS variable of a component's colour, without --; colours of joints are reserved for joints. */
export function componentColour(name) {
  return name in NAMES ? `version-${Object.keys(NAMES).indexOf(name) + 1}` : "muted";
}
