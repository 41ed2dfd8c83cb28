// Notes on samples that the version was trained on: their figures are optimistic.

import { h } from "../../dom.js";
import { HELD_OUT_NOTE } from "../job/words.js";

/** Return notes for an evaluation or a trace; none if its samples are new to the version. */
export function trainingDataNotes({ version, revision, in_training: trained, part }) {
  const notes = [];
  if (trained && part === "held_out") {
    return [h("p", { class: "hint" }, `${HELD_OUT_NOTE} The figures are those of the evaluation. The torque plots are of version ${version}, which was trained on these rows.`)];
  }
  if (trained) {
    notes.push(h("div", { class: "banner", role: "note" },
      h("strong", {}, "Optimistic figures. "),
      `Version ${version} was trained on some or all of these samples. Select a recording that it was not trained on.`));
  }
  if (revision > 0) {
    notes.push(h("div", { class: "banner", role: "note" },
      `Version ${version} has learnt online since its training (revision ${revision}). If it learnt from this recording, figures and plots are optimistic.`));
  }
  if (!trained && part === "held_out") {
    notes.push(h("p", { class: "hint" }, `These samples were held out of the training of version ${version}.`));
  }
  return notes;
}
