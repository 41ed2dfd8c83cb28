// Codes of rows: label, explanation, and a symbol that does not depend on colour. `lasting`: usually many rows in sequence.

export const CODES = {
  learnt: { words: "learnt" },
  contact: { words: "contact", why: "torque far outside the interval, as in a collision", symbol: "x", colour: "contact" },
  change: { words: "waiting for a decision", why: "the robot may have changed", symbol: "star", colour: "contact", lasting: true },
  payload: { words: "with a payload", why: "used to estimate the payload, not to learn the arm", symbol: "square", colour: "payload", lasting: true },
  saturation: { words: "saturated", why: "torque at the limit of its actuator", symbol: "square-open", colour: "novel" },
  stationary: { words: "at rest", why: "stiction hides the torque", symbol: "circle-open", colour: "muted", lasting: true },
  limit: { words: "limit exceeded", why: "position, speed, acceleration or torque", symbol: "triangle-up-open", colour: "contact" },
  non_finite: { words: "not a number", why: "a value is missing or not finite", symbol: "cross-open", colour: "contact" },
  time_jump: { words: "time jump", why: "time decreases or skips", symbol: "triangle-left-open", colour: "novel" },
  implausible: { words: "implausible", why: "zero against gravity, equal to the prediction, or constant while the arm moves", symbol: "hourglass-open", colour: "bad", lasting: true },
  paused: { words: "learning paused", why: "compared with the prediction, but not learnt", symbol: "square-x-open", colour: "muted", lasting: true },
  late: { words: "too late", why: "older than the forgetting time", symbol: "triangle-left", colour: "muted" },
  edge: { words: "acceleration pending", why: "learnt with the next batch", symbol: "line-ew-open", colour: "muted" },
};
export const NOVEL = { words: "outside the training data", symbol: "diamond-open", colour: "novel" };

/** Return the label of a code. */
export function codeLabel(code) {
  return CODES[code]?.words ?? code;
}
