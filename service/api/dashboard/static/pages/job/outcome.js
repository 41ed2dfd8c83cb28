// Result of a job: quality of the version, or the cause of the failure.

import { get, path } from "../../api.js";
import { qualityCharts } from "../../charts.js";
import { h, replace } from "../../dom.js";
import { count, nmse, number, percent, shortNames } from "../../format.js";
import { card, link, table } from "../../ui.js";
import { warningBanner } from "../data/prose.js";
import { coverageInterval } from "../model/coverage.js";
import { learningCurveCard } from "../model/learning_curve.js";
import { promotionNote } from "../model/promotion.js";
import { selectionCard } from "../model/selection.js";
import { verdictNote } from "../verdict.js";
import { HELD_OUT_NOTE } from "./words.js";

const ADVICE = {
  cannot_hold_out: "Hold out less, choose another part, or hold out nothing.",
  not_positive_definite: "The samples may be nearly identical, or their torque may have no noise. Check the reports of the data sets.",
  damaged_data: "The file of a data set is damaged. Upload the recording again.",
  storage_full: "Delete data sets or versions that you no longer need, then retry.",
  too_long: "Train on fewer samples or with fewer iterations.",
  interrupted: "The service was stopped too often during the job. Retry.",
};

/** Show the result in an element. */
export async function outcome(element, job, signal) {
  if (job.state === "succeeded") return replace(element, await versionResult(job, signal));
  if (job.state !== "failed") return replace(element);
  const advice = ADVICE[job.error?.code] ?? "See the service's log for details, and check the reports of the data sets.";
  return replace(
    element,
    h("div", { class: "error", role: "alert" }, h("p", {}, h("strong", {}, "Training failed. "), job.error?.message ?? ""), h("p", {}, advice)),
  );
}

async function versionResult(job, signal) {
  const more = link(`Version ${job.version} of ${job.model}`, `#/models/${job.model}?version=${job.version}`);
  let version;
  try {
    version = await get(path`/v1/models/${job.model}/versions/${String(job.version)}`, {}, signal);
  } catch (error) {
    return card("Result", h("p", {}, more, `: ${error.message}`));
  }
  const held = version.lineage.holdout;
  const trained = version.lineage.training_metrics;
  const made = card(
    "Result",
    h("p", {}, more, servingNote(job, version)),
    verdictNote(version.verdict),
    promotionNote(version),
    warningBanner([...version.warnings, ...(held?.warnings ?? [])]),
    held?.nmse
      ? [figures(`On ${count(held.samples)} held-out samples`, held, version), held.learnt ? h("p", { class: "hint" }, HELD_OUT_NOTE) : null]
      : null,
    !held?.nmse && trained?.nmse ? figures(`On ${count(trained.samples)} training samples: these figures are optimistic`, trained, version) : null,
  );
  return [made, selectionCard(version), learningCurveCard(version)];
}

function servingNote(job, { promotion }) {
  if (job.refresh) return ". It starts serving once it predicts better than the current version.";
  return promotion?.answers === false ? ". It is a candidate and does not serve." : ". It serves unless another version was chosen.";
}

function figures(caption, found, version) {
  const names = shortNames(version.joint_names);
  return [h("div", { class: "charts wide" }, qualityCharts(names, found)), figuresTable(caption, found, names, version.joint_types)];
}

function figuresTable(caption, found, names, types) {
  const unit = types.includes("prismatic") ? "N·m or N" : "N·m";
  return table(
    [
      { label: "Joint", cell: (row) => row.name },
      { label: "nMSE", numeric: true, cell: (row) => nmse(row.nmse) },
      { label: "95\u00a0% coverage", numeric: true, cell: (row) => percent(row.coverage) },
      { label: "95\u00a0% CI of coverage", numeric: true, cell: (row) => row.interval },
      { label: `RMSE, ${unit}`, numeric: true, cell: (row) => number(row.rmse) },
      { label: `95\u00a0% interval width, ${unit}`, numeric: true, cell: (row) => (row.width === undefined ? "–" : number(row.width)) },
    ],
    names.map((name, index) => ({ name, nmse: found.nmse[index], rmse: found.rmse[index], coverage: found.coverage[index], interval: coverageInterval(found, index), width: found.interval_width?.[index] })),
    { caption },
  );
}
