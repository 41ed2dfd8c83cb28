// Two versions on one recording: which predicts better, and whether that may be chance.

import { post } from "../../api.js";
import { h, replace } from "../../dom.js";
import { count, counted, number, percent, scientific, shortNames } from "../../format.js";
import { badge, button, errorBox, field, loading, select, table } from "../../ui.js";
import { fitting, noData, relation } from "./choice.js";

const SIGN = { no_difference: "plain", cannot_tell: "warn" };

/** The form, and below it the answer. */
export function compareForm(state, signal) {
  const { model, version, datasets } = state;
  const offered = fitting(version, datasets);
  if (!offered.length) return noData(state);
  const numbers = [...model.versions].reverse().map((each) => [String(each.version), `version ${each.version}, ${each.estimator}`]);
  const other = numbers.find(([number_]) => Number(number_) !== model.serving_version)[0];
  const first = select(numbers, String(model.serving_version)), second = select(numbers, other);
  const dataset = select(offered.map((each) => [each.id, `${each.name || each.id}${relation(version, each) ? `, ${relation(version, each)}` : ""}`]), state.dataset);
  const answer = h("div", { "aria-live": "polite" });
  const go = button("Compare", async () => {
    replace(answer, loading("Comparing"));
    try {
      const request = { dataset: dataset.value, versions: [Number(first.value), Number(second.value)] };
      replace(answer, verdict(await post(`${state.where}/compare`, request, signal)));
    } catch (error) {
      if (error.name !== "AbortError") replace(answer, errorBox(error));
    }
  }, { kind: "primary" });
  return [h("div", { class: "grid" }, field("First", first), field("Second", second), field("Recording", dataset)), h("p", {}, go), answer];
}

function verdict(said) {
  const [one, two] = said.versions;
  const short = shortNames(said.joint_names);
  const label = said.better === null ? said.outcome.replace("_", " ") : `version ${said.better} is better`;
  const difference = (joint) => {
    const { difference: by, half_width: half } = said.differences.nlpd;
    return `${number(by[joint])}${half[joint] === null ? "" : ` ± ${number(half[joint], 2)}`}`;
  };
  const numeric = (heading, cell) => ({ label: heading, numeric: true, cell });
  const columns = [
    { label: "Joint", cell: (joint) => short[joint] },
    numeric(`nMSE, v${one.version}`, (joint) => scientific(one.nmse[joint])),
    numeric(`nMSE, v${two.version}`, (joint) => scientific(two.nmse[joint])),
    numeric(`in 95 %, v${one.version}`, (joint) => percent(one.coverage[joint])),
    numeric(`in 95 %, v${two.version}`, (joint) => percent(two.coverage[joint])),
    numeric(`NLPD, v${two.version} − v${one.version}`, difference),
  ];
  return [
    said.warnings.map((text) => h("div", { class: "banner", role: "note" }, `Unfair: ${text}.`)),
    h("p", {}, badge(label, SIGN[said.outcome] ?? "good"), " ", said.verdict),
    table(columns, said.joint_names.map((_name, joint) => joint), { caption: `${count(said.samples_used)} of ${count(said.samples)} samples in ${counted(said.blocks, "block")}; ± is half of a 95 % interval` }),
    h("p", { class: "hint" }, "NLPD is the negative log predictive density, in nats a sample. It rewards small errors and true uncertainty. Below zero, the second version is better."),
  ];
}
