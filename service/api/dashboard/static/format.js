// Numbers, times and sizes as people read them.

const NONE = "–";
const known = (x) => x !== null && x !== undefined && Number.isFinite(x);

/** A number with so many significant digits: 0.0123, 12.3, 1.2e-7. */
export function number(x, digits = 3) {
  if (!known(x)) return NONE;
  if (x === 0) return "0";
  const size = Math.abs(x);
  if (size >= 1e6 || size < 1e-4) return scientific(x, digits - 1);
  return Number(x.toPrecision(digits)).toString();
}

/** 1.2e-4, as nMSE is written. */
export function scientific(x, digits = 1) {
  return known(x) ? x.toExponential(digits).replace("e+", "e") : NONE;
}

/** An nMSE: 0.071, and below a thousandth 3.1e-4. */
export function nmse(x) {
  return known(x) && (x === 0 || x >= 1e-3) ? number(x, 2) : scientific(x);
}

/** A whole number with thin spaces between thousands. */
export function count(x) {
  return known(x) ? Math.round(x).toLocaleString("en").replaceAll(",", "\u202f") : NONE;
}

/** 1 episode, 2 episodes. */
export function counted(x, what, plural = `${what}s`) {
  return `${count(x)} ${x === 1 ? what : plural}`;
}

/** A share as 94.5 %. */
export function percent(x, digits = 1) {
  return known(x) ? `${(100 * x).toFixed(digits)}\u00a0%` : NONE;
}

/** A duration: 350 µs, 2.1 ms, 12 s, 3 min 5 s, 2 h 4 min. */
export function seconds(x) {
  if (!known(x)) return NONE;
  if (x < 1e-3) return `${number(x * 1e6, 3)}\u00a0µs`;
  if (x < 1) return `${number(x * 1e3, 3)}\u00a0ms`;
  if (x < 60) return `${number(x, x < 10 ? 2 : 3)}\u00a0s`;
  if (x < 3600) return `${Math.floor(x / 60)}\u00a0min ${Math.round(x % 60)}\u00a0s`;
  return `${Math.floor(x / 3600)}\u00a0h ${Math.round((x % 3600) / 60)}\u00a0min`;
}

/** How long ago a time (ISO 8601, or Unix seconds) was. */
export function ago(time) {
  const passed = (Date.now() - date(time).getTime()) / 1000;
  if (!known(passed)) return NONE;
  if (passed < 5) return "just now";
  if (passed < 90) return `${Math.round(passed)} s ago`;
  if (passed < 5400) return `${Math.round(passed / 60)} min ago`;
  if (passed < 129600) return `${Math.round(passed / 3600)} h ago`;
  return `${counted(Math.round(passed / 86400), "day")} ago`;
}

/** A time (ISO 8601, or Unix seconds) in the reader's own zone. */
export function when(time) {
  const at = date(time);
  return Number.isNaN(at.getTime()) ? NONE : at.toLocaleString("en-GB", { dateStyle: "medium", timeStyle: "medium" });
}

/** A mass as it is known: 1.48 ± 0.03 kg, 1.498 ± 0.004 kg; null: none. */
export function kilograms(mass) {
  if (mass === null) return "nothing";
  const digits = mass.std < 0.005 ? 3 : 2;
  return `${mass.mean.toFixed(digits)} ± ${mass.std.toFixed(digits)}\u00a0kg`;
}

/** A time as `when` has it, without the day where that is today. */
export function moment(time) {
  return date(time).toDateString() === new Date().toDateString() ? date(time).toLocaleTimeString("en-GB") : when(time);
}

/** A size: 12 kB, 3.4 MB. */
export function bytes(x) {
  if (!known(x)) return NONE;
  const units = ["B", "kB", "MB", "GB", "TB"];
  const power = x < 1000 ? 0 : Math.min(units.length - 1, Math.floor(Math.log10(x) / 3));
  return `${number(x / 1000 ** power, 3)}\u00a0${units[power]}`;
}

/** The unit of a joint's torque: N·m, or N of a joint that slides. */
export function torqueUnit(type) {
  return type === "prismatic" ? "N" : "N·m";
}

/** A joint's name without the prefix that all joints of the robot share: panda_joint1 → joint1. */
export function shortNames(names) {
  if (names.length < 2) return [...names];
  let end = 0;
  while (names.every((name) => name[end] !== undefined && name[end] === names[0][end])) end += 1;
  const cut = Math.max(...[..."_/."].map((mark) => names[0].lastIndexOf(mark, end - 1))) + 1;
  return names.map((name) => name.slice(cut) || name);
}

function date(time) {
  return new Date(typeof time === "number" ? time * 1000 : time);
}
