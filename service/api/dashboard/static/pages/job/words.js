// What a job is doing, in words.

import { seconds } from "../../format.js";

/** States of jobs that have not ended. */
export const ACTIVE = new Set(["queued", "running"]);

const STAGES = {
  waiting: "waiting for its turn",
  loading: "loading the data",
  geometry: "searching for the joint axes",
  hyperparameters: "fitting hyperparameters",
  posterior: "computing the posterior",
  statistics: "summing up all rows",
  evaluating: "evaluating on the held-out part",
  all_rows: "training on all rows, held out or not",
  saving: "saving the version",
  done: "done",
};

/** The stage of a job's work. */
export function stage({ progress: at }) {
  if (at.stage === "hyperparameters" && !at.iteration) return "choosing where to start the fit";
  const doing = STAGES[at.stage] ?? at.stage;
  return at.estimator ? `${at.estimator}: ${doing}` : doing;
}

/** What is left of its time, empty where that is not known. */
export function left({ progress: at }) {
  return at.remaining_s === null ? "" : `at most about ${seconds(Math.ceil(at.remaining_s))}`;
}

/** Of figures of a version that has learnt what was held out: which fit they are of. */
export const JUDGED = "Judged on held-out rows; the version was then trained on all rows.";

/** What was held out, in a sentence. */
export function heldOut(holdout) {
  if (!holdout) return "nothing";
  const share = `${Math.round(100 * holdout.share)}\u00a0%`;
  const guard = holdout.guard_s === null ? "" : `, with a guard of ${holdout.guard_s} s`;
  const what = {
    last: `the last ${share} of each data set`,
    auto: `${share}: the last part, unless it repeats the rest`,
    episodes: `${share}, in whole episodes chosen by seed ${holdout.seed}`,
    blocks: `${share}, in some of ${holdout.blocks} blocks chosen by seed ${holdout.seed}`,
  };
  return `${what[holdout.kind]}${guard}${holdout.only ? ", and never learnt" : ""}`;
}
