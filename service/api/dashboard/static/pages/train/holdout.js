// What is held out of the data, so that the version can be judged by what it has not seen.

import { h } from "../../dom.js";
import { field } from "../../ui.js";

const KINDS = [
  ["auto", "the last part, unless it repeats the rest"],
  ["last", "the last part of each recording"],
  ["episodes", "whole episodes"],
  ["blocks", "some of many equal blocks"],
  ["", "nothing: learn from all of it"],
];
const SAID = {
  auto: "If the last part only repeats earlier motion, one that does not is taken instead.",
  last: "This does not test other kinds of motion: evaluate on another recording for that.",
  episodes: "The seed chooses which. Of recordings with one episode each, whole recordings are held out.",
  blocks: "The seed chooses which. Blocks resemble their neighbours, so figures look better than on a new recording.",
  stretches: "The rows that you have chosen on the recording’s page. Other recordings are learnt from.",
  "": "Then nothing shows how well the model predicts. Choose this only once you have judged it on another recording.",
};

/**
 * The part of the form. named: rows that a data set's page was asked to hold out, {data set: [[first, last]]}, or null.
 * Returns {element, value()}: the holdout of a job request, null for nothing.
 */
export function holdoutChoice(named = null) {
  const kinds = named ? [["stretches", "what was chosen in the plots"], ...KINDS] : KINDS;
  const kind = h("select", { name: "holdout.kind" }, kinds.map(([value, label]) => h("option", { value }, label)));
  const share = number("holdout.share", 30, { min: 1, max: 90, step: "any", required: true });
  const blocks = number("holdout.blocks", 10, { min: 2, max: 1000, step: 1 });
  const seed = number("holdout.seed", 0, { min: 0, max: 2147483647, step: 1 });
  const guard = h("input", { type: "number", name: "holdout.guard_s", min: "0", max: "3600", step: "any", placeholder: "one period of the low-pass" });
  const only = h("input", { type: "checkbox", name: "holdout.only" });
  const about = h("p", { class: "hint" });
  const fields = {
    share: field("Share, %", share),
    blocks: field("Blocks", blocks),
    seed: field("Seed of the choice", seed),
    guard: field("Guard, s", guard, "Samples this close to the border are not used to judge, nor learnt before."),
    only: field("Never learn this part", only),
  };
  const show = () => {
    about.textContent = SAID[kind.value];
    fields.guard.hidden = fields.only.hidden = kind.value === "";
    fields.share.hidden = kind.value === "" || kind.value === "stretches";
    fields.blocks.hidden = kind.value !== "blocks";
    fields.seed.hidden = kind.value !== "blocks" && kind.value !== "episodes";
    share.disabled = kind.value === ""; // a hidden value must not keep the form from being sent
  };
  kind.addEventListener("change", show);
  show();
  return {
    element: h(
      "fieldset",
      {},
      h("legend", {}, "Hold out"),
      h("p", { class: "hint" }, "The model is judged on this part without having learnt it. Then it is trained on all rows."),
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
