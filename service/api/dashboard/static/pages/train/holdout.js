// Choice of the part that is held out of the training to evaluate the version.

import { h } from "../../dom.js";
import { field } from "../../ui.js";

const KINDS = [
  ["auto", "automatic"],
  ["last", "the last part of each recording"],
  ["episodes", "whole episodes"],
  ["blocks", "random blocks"],
  ["", "nothing"],
];
const EXPLANATIONS = {
  auto: "The last part of each recording, or another part if the last one repeats earlier motion.",
  last: "This does not test other kinds of motion. To do so, evaluate the version on another recording.",
  episodes: "The seed selects the episodes. If every recording has one episode, whole recordings are held out.",
  blocks: "The seed selects the blocks. They resemble their neighbours, so the figures are better than on a new recording.",
  stretches: "The rows that you selected on the page of the recording. All other recordings are used for training.",
  "": "The quality of the version remains unknown. Choose this only if you evaluate it on another recording.",
};

/**
 * Create this part of the form. named: rows selected on the page of a data set, {data set: [[first, last]]}, or null.
 * Returns {element, value()}; value(): the holdout of a job request, null for nothing.
 */
export function holdoutChoice(named = null) {
  const kinds = named ? [["stretches", "the range selected in the plots"], ...KINDS] : KINDS;
  const kind = h("select", { name: "holdout.kind" }, kinds.map(([value, label]) => h("option", { value }, label)));
  const share = number("holdout.share", 30, { min: 1, max: 90, step: "any", required: true });
  const blocks = number("holdout.blocks", 10, { min: 2, max: 1000, step: 1 });
  const seed = number("holdout.seed", 0, { min: 0, max: 2147483647, step: 1 });
  const guard = h("input", { type: "number", name: "holdout.guard_s", min: "0", max: "3600", step: "any", placeholder: "one period of the low-pass filter" });
  const only = h("input", { type: "checkbox", name: "holdout.only" });
  const about = h("p", { class: "hint" });
  const fields = {
    share: field("Share, %", share),
    blocks: field("Blocks", blocks),
    seed: field("Seed", seed),
    guard: field("Guard, s", guard, "Samples this close to the boundary are used neither for training nor for evaluation."),
    only: field("Never train on this part", only),
  };
  const show = () => {
    about.textContent = EXPLANATIONS[kind.value];
    fields.guard.hidden = fields.only.hidden = kind.value === "";
    fields.share.hidden = kind.value === "" || kind.value === "stretches";
    fields.blocks.hidden = kind.value !== "blocks";
    fields.seed.hidden = kind.value !== "blocks" && kind.value !== "episodes";
    share.disabled = kind.value === ""; // a hidden invalid value must not block the form
  };
  kind.addEventListener("change", show);
  show();
  return {
    element: h(
      "fieldset",
      {},
      h("legend", {}, "Hold out"),
      h("p", { class: "hint" }, "The model is first trained without this part and evaluated on it. Then it is trained on all rows."),
      h("div", { class: "grid" }, field("Which part", kind), fields.share, fields.blocks, fields.seed, fields.guard),
      fields.only,
      about,
    ),
    value: () => {
      if (!kind.value) return null;
      const chosen = { kind: kind.value, ...(kind.value === "stretches" ? { stretches: named } : { share: share.valueAsNumber / 100 }) };
      if (only.checked) chosen.only = true;
      if (kind.value === "blocks") chosen.blocks = blocks.valueAsNumber;
      if (kind.value !== "last" && kind.value !== "stretches") chosen.seed = seed.valueAsNumber;
      return guard.value ? { ...chosen, guard_s: guard.valueAsNumber } : chosen;
    },
  };
}

function number(name, value, limits) {
  return h("input", { type: "number", name, value: String(value), required: true, ...limits });
}
