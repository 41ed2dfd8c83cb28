// What makes figures look better than they are, said before they are seen.

import { h } from "../../dom.js";
import { JUDGED } from "../job/words.js";

/** Sentences about an evaluation or a trace; nothing where its samples are new to the version. */
export function flattery({ version, revision, in_training: trained, part }) {
  const said = [];
  if (trained && part === "held_out") {
    return [h("p", { class: "hint" }, `${JUDGED} Figures are of the judged fit. Plots of the torque are of version ${version} itself, which has learnt these rows.`)];
  }
  if (trained) {
    said.push(h("div", { class: "banner", role: "note" },
      h("strong", {}, "These samples flatter. "),
      `Version ${version} was trained on them, or on some of them. Figures and plots look better than on other motion. Choose a recording that it has not seen.`));
  }
  if (revision > 0) {
    said.push(h("div", { class: "banner", role: "note" },
      `Version ${version} has learnt online since it was trained (revision ${revision}). If it learnt from this motion, figures and plots flatter it.`));
  }
  if (!trained && part === "held_out") {
    said.push(h("p", { class: "hint" }, `These samples were held out when version ${version} was trained.`));
  }
  return said;
}
