// Formats numbers, times and sizes for people.

const UNKNOWN = "–";
const MAX_TIME_S = 1e6;
const isKnown = (x) => x !== null && x !== undefined && Number.isFinite(x);

/** Format a number with significant digits: 0.0123, 12.3, 1.2e-7. */
export function number(x, digits = 3) {
  if (!isKnown(x)) return UNKNOWN;
  if (x === 0) return "0";
  const size = Math.abs(x);
  if (size >= 1e6 || size < 1e-4) return scientific(x, digits - 1);
  return Number(x.toPrecision(digits)).toString();
}

/** Format a number as 1.2e-4. */
export function scientific(x, digits = 1) {
  return isKnown(x) ? x.toExponential(digits).replace("e+", "e") : UNKNOWN;
}

/** Format an nMSE: 0.071, below a thousandth 3.1e-4. */
export function nmse(x) {
  return isKnown(x) && (x === 0 || x >= 1e-3) ? number(x, 2) : scientific(x);
}

/** Format an integer with thin spaces between thousands. */
export function count(x) {
  return isKnown(x) ? Math.round(x).toLocaleString("en").replaceAll(",", "\u202f") : UNKNOWN;
}

/** Format a number of things: 1 episode, 2 episodes. */
export function counted(x, what, plural = `${what}s`) {
  return `${count(x)} ${x === 1 ? what : plural}`;
}

/** Format a share as 94.5 %. */
export function percent(x, digits = 1) {
  return isKnown(x) ? `${(100 * x).toFixed(digits)}\u00a0%` : UNKNOWN;
}

/** Format a duration: 350 µs, 2.1 ms, 12 s, 3 min 5 s, 2 h 4 min. */
export function seconds(x) {
  if (!isKnown(x)) return UNKNOWN;
  if (x < 1e-3) return `${number(x * 1e6, 3)}\u00a0µs`;
  if (x < 1) return `${number(x * 1e3, 3)}\u00a0ms`;
  if (x < 60) return `${number(x, x < 10 ? 2 : 3)}\u00a0s`;
  if (x < 3600) return `${Math.floor(x / 60)}\u00a0min ${Math.round(x % 60)}\u00a0s`;
  return `${Math.floor(x / 3600)}\u00a0h ${Math.round((x % 3600) / 60)}\u00a0min`;
}

/** Format how long ago a time was. time: ISO 8601 or Unix seconds. */
export function ago(time) {
  const passed = (Date.now() - date(time).getTime()) / 1000;
  if (!isKnown(passed)) return UNKNOWN;
  if (passed < 5) return "just now";
  if (passed < 90) return `${Math.round(passed)} s ago`;
  if (passed < 5400) return `${Math.round(passed / 60)} min ago`;
  if (passed < 129600) return `${Math.round(passed / 3600)} h ago`;
  return `${counted(Math.round(passed / 86400), "day")} ago`;
}

/** Format date and time in the reader's time zone. time: ISO 8601 or Unix seconds. */
export function when(time) {
  const at = date(time);
  return Number.isNaN(at.getTime()) ? UNKNOWN : at.toLocaleString("en-GB", { dateStyle: "medium", timeStyle: "medium" });
}

/** Return the time from which plots count: 0, or the first time if it is of a clock, whose digits do not fit the axis. */
export function timeOrigin(first) {
  return Math.abs(first) > MAX_TIME_S ? first : 0;
}

/** Format a payload: 1.48 ± 0.03 kg, 1.498 ± 0.004 kg. mass: {mean, std}; null: none. */
export function kilograms(mass) {
  if (mass === null) return "no payload";
  const digits = mass.std < 0.005 ? 3 : 2;
  return `${mass.mean.toFixed(digits)} ± ${mass.std.toFixed(digits)}\u00a0kg`;
}

/** Format a time like `when`, without the date if it is today. */
export function moment(time) {
  return date(time).toDateString() === new Date().toDateString() ? date(time).toLocaleTimeString("en-GB") : when(time);
}

/** Format a size: 12 kB, 3.4 MB. */
export function bytes(x) {
  if (!isKnown(x)) return UNKNOWN;
  const units = ["B", "kB", "MB", "GB", "TB"];
  const power = x < 1000 ? 0 : Math.min(units.length - 1, Math.floor(Math.log10(x) / 3));
  return `${number(x / 1000 ** power, 3)}\u00a0${units[power]}`;
}

/** Return the unit of a joint's torque: N·m, or N for a prismatic joint. */
export function torqueUnit(type) {
  return type === "prismatic" ? "N" : "N·m";
}

/** Return joint names without the prefix and the suffix that all joints share: panda_joint1 → joint1, elbow_joint → elbow. */
export function shortNames(names) {
  if (names.length < 2) return [...names];
  const parts = names.map((name) => name.split(/(?<=[_/.])/)); // each part ends with its mark
  const shared = (at) => parts.every((each) => each.length > 1 && each.at(at) === parts[0].at(at));
  while (shared(0)) for (const each of parts) each.shift();
  while (shared(-1)) for (const each of parts) each.pop();
  return parts.map((each) => each.join("").replace(/[_/.]$/, ""));
}

/** Return text from the service as a sentence: a capital first letter and a full stop. */
export function sentence(text) {
  const whole = `${text.slice(0, 1).toUpperCase()}${text.slice(1)}`;
  return /[.!?]$/.test(whole) ? whole : `${whole}.`;
}

function date(time) {
  return new Date(typeof time === "number" ? time * 1000 : time);
}
