// What became of a row: in words, and as a symbol that does not need its colour; `lasting` where it goes on for long.

export const CODES = {
  learnt: { words: "learnt" },
  contact: { words: "contact", why: "torque far outside the interval, as in a collision", symbol: "x", colour: "contact" },
  change: { words: "waits for a decision", why: "the robot seems to have changed", symbol: "star", colour: "contact", lasting: true },
  payload: { words: "with a payload", why: "teaches what the arm carries, and not the arm", symbol: "square", colour: "payload", lasting: true },
  saturation: { words: "saturated", why: "torque at its actuator’s limit", symbol: "square-open", colour: "novel" },
  stationary: { words: "at rest", why: "stiction hides the torque", symbol: "circle-open", colour: "muted", lasting: true },
  limit: { words: "beyond a limit", why: "position, speed, acceleration or torque", symbol: "triangle-up-open", colour: "contact" },
  non_finite: { words: "not a number", why: "a value is missing or not finite", symbol: "cross-open", colour: "contact" },
  time_jump: { words: "time jumped", why: "time goes backwards or skips", symbol: "triangle-left-open", colour: "novel" },
  implausible: { words: "not measured", why: "zero against gravity, the model's own answer, or the same all the time while the arm moves", symbol: "hourglass-open", colour: "bad", lasting: true },
  paused: { words: "learning paused", why: "judged and compared, but not learnt", symbol: "square-x-open", colour: "muted", lasting: true },
  late: { words: "too late", why: "forgotten by the time it came", symbol: "triangle-left", colour: "muted" },
  edge: { words: "acceleration not known yet", why: "used with the next batch", symbol: "line-ew-open", colour: "muted" },
};
export const NOVEL = { words: "beyond what was trained on", symbol: "diamond-open", colour: "novel" };

/** A code in words. */
export function words(code) {
  return CODES[code]?.words ?? code;
}
