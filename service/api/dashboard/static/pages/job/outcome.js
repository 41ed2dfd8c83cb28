// What came of a job: how good the version is, or why there is none.

import { get, path } from "../../api.js";
import { qualityCharts } from "../../charts.js";
import { h, replace } from "../../dom.js";
import { count, nmse, number, percent, shortNames } from "../../format.js";
import { card, link, table } from "../../ui.js";
import { warned } from "../data/prose.js";
import { known, narrowJoints } from "../model/coverage.js";
import { promoted } from "../model/promotion.js";
import { selectionCard } from "../model/selection.js";
import { JUDGED } from "./words.js";

const ADVICE = {
  cannot_hold_out: "Hold out less, or in another way, or nothing.",
  not_positive_definite: "The samples may be nearly equal, or their torque without noise. Look at the data sets' reports.",
  damaged_data: "A data set's file is damaged: upload the recording again.",
  storage_full: "Delete data sets or versions that are no longer needed, then try again.",
  too_long: "Train on fewer samples or with fewer iterations.",
  interrupted: "The service was stopped too often while it ran. Try again.",
};

/** Show it in an element. */
export async function outcome(element, job, signal) {
  if (job.state === "succeeded") return replace(element, await judged(job, signal));
  if (job.state !== "failed") return replace(element);
  const advice = ADVICE[job.error?.code] ?? "The service's log says more. The data sets' reports may show what is wrong.";
  return replace(
    element,
    h("div", { class: "error", role: "alert" }, h("p", {}, h("strong", {}, "The training failed. "), job.error?.message ?? ""), h("p", {}, advice)),
  );
}

async function judged(job, signal) {
  const more = link(`Version ${job.version} of ${job.model}`, `#/models/${job.model}?version=${job.version}`);
  let version;
  try {
    version = await get(path`/v1/models/${job.model}/versions/${String(job.version)}`, {}, signal);
  } catch (error) {
    return card("Result", h("p", {}, more, `: ${error.message}`));
  }
  const held = version.lineage.holdout;
  const seen = version.lineage.training_metrics;
  const made = card(
    "Result",
    h("p", {}, more, answers(job, version)),
    promoted(version),
    warned([...version.warnings, ...(held?.warnings ?? [])]),
    held?.nmse
      ? [figures(`On ${count(held.samples)} samples that were held out`, held, version), held.learnt ? h("p", { class: "hint" }, JUDGED) : null]
      : h("p", { class: "banner" }, "Nothing was held out, so how well it predicts is not known. Evaluate it on a recording that it has not seen."),
    !held?.nmse && seen?.nmse ? figures(`On ${count(seen.samples)} samples it was trained on: these figures flatter`, seen, version) : null,
  );
  return [made, selectionCard(version)];
}

function answers(job, { promotion }) {
  if (job.refresh) return ", which answers once it has predicted better than the old one.";
  return promotion?.answers === false ? ", which waits as candidate." : ", which answers from now on unless another version was chosen to serve.";
}

function figures(caption, found, version) {
  const names = shortNames(version.joint_names);
  return [verdicts(found, names), h("div", { class: "charts wide" }, qualityCharts(names, found)), shownFigures(caption, found, names, version.joint_types)];
}

/** What the figures say to be careful with. */
function verdicts(found, names) {
  const joints = names.map((name, index) => ({ name, nmse: found.nmse[index] }));
  const narrow = narrowJoints(found);
  const useless = joints.filter((each) => each.nmse !== null && each.nmse >= 1);
  const said = [];
  if (narrow.length) {
    const which = narrow.map((joint) => `${names[joint]} (${percent(found.coverage[joint], 0)})`).join(", ");
    said.push(`The 95 % band is too narrow for ${which}: the model is overconfident there.`);
  }
  if (useless.length) {
    said.push(`Predictions of ${useless.map((each) => each.name).join(", ")} are no better than a constant torque: nMSE of 1 and more.`);
  }
  return said.length ? h("div", { class: "banner" }, said.map((text) => h("p", {}, text))) : null;
}

function shownFigures(caption, found, names, types) {
  const unit = types.includes("prismatic") ? "N·m or N" : "N·m";
  return table(
    [
      { label: "Joint", cell: (row) => row.name },
      { label: "nMSE", numeric: true, cell: (row) => nmse(row.nmse) },
      { label: "in 95\u00a0%", numeric: true, cell: (row) => percent(row.coverage) },
      { label: "known to be", numeric: true, cell: (row) => row.known },
      { label: `RMSE, ${unit}`, numeric: true, cell: (row) => number(row.rmse) },
      { label: `95\u00a0% width, ${unit}`, numeric: true, cell: (row) => (row.width === undefined ? "–" : number(row.width)) },
    ],
    names.map((name, index) => ({ name, nmse: found.nmse[index], rmse: found.rmse[index], coverage: found.coverage[index], known: known(found, index), width: found.interval_width?.[index] })),
    { caption },
  );
}
