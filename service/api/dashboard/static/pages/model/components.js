// Components of a torque: which a version offers, their names and colours.

const NAMES = { inertial: "inertial, M(q) ddq", coriolis: "Coriolis and centrifugal", gravity: "gravity", friction: "friction" };

/** Return the torque components that a version offers. */
export function offered({ components }) {
  return Object.keys(NAMES).filter((name) => components.includes(name));
}

/** Return the label of a component. */
export function componentLabel(name) {
  return NAMES[name] ?? "all else";
}

/** Return the CSS variable of a component's colour, without --; colours of joints are reserved for joints. */
export function componentColour(name) {
  return name in NAMES ? `version-${Object.keys(NAMES).indexOf(name) + 1}` : "muted";
}
