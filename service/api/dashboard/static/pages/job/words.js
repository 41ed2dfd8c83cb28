// Texts about jobs: stages, remaining time, held-out parts.

import { seconds } from "../../format.js";

/** States of jobs that have not ended. */
export const ACTIVE = new Set(["queued", "running"]);

const STAGES = {
  waiting: "queued",
  loading: "loading the data",
  geometry: "fitting the joint axes",
  hyperparameters: "fitting hyperparameters",
  posterior: "computing the posterior",
  statistics: "computing statistics of all rows",
  evaluating: "evaluating on the held-out part",
  learning_curve: "training on fewer rows for the learning curve",
  all_rows: "training on all rows",
  saving: "saving the version",
  done: "done",
};

/** Describe the current stage of a job. */
export function stage({ progress: at }) {
  if (at.stage === "hyperparameters" && !at.iteration) return "choosing the start of the fit";
  const doing = STAGES[at.stage] ?? at.stage;
  return at.estimator ? `${at.estimator}: ${doing}` : doing;
}

/** Describe the remaining time of a job; an empty text if it is unknown. */
export function remaining({ progress: at }) {
  return at.remaining_s === null ? "" : `up to ${seconds(Math.ceil(at.remaining_s))}`;
}

/** Note on the figures of a version that was trained on the held-out rows in the end. */
export const HELD_OUT_NOTE = "Evaluated on held-out rows. The version was then trained on all rows.";

/** Describe the held-out part. */
export function heldOut(holdout) {
  if (!holdout) return "nothing";
  const share = `${Math.round(100 * holdout.share)}\u00a0%`;
  const guard = holdout.guard_s === null ? "" : `, guard of ${holdout.guard_s} s`;
  const what = {
    last: `the last ${share} of each data set`,
    auto: `${share}: the last part, or another one if that repeats earlier motion`,
    episodes: `${share}: whole episodes, seed ${holdout.seed}`,
    blocks: `${share}: some of ${holdout.blocks} blocks, seed ${holdout.seed}`,
  };
  return `${what[holdout.kind]}${guard}${holdout.only ? ", never trained on" : ""}`;
}
