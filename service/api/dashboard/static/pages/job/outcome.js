// Result of a job: verdict on the version and its errors by joint, or the cause of the failure.

import { get, path } from "../../api.js";
import { jointVar } from "../../colours.js";
import { Await, Card, Table, useRead } from "../../components.js";
import { count, nmse, number, percent, shortNames, torqueUnit } from "../../format.js";
import { LearningCurve } from "../../learning_curve.js";
import { JointVerdicts } from "../../jointverdicts.js";
import { html } from "../../preact.js";
import { SelectionCard } from "../../selection.js";
import { VerdictNote } from "../../verdicts.js";
import { Warnings } from "../data/findings.js";
import { Objective, OBJECTIVE_HINT } from "./objective.js";
import { HELD_OUT_NOTE } from "./words.js";

const ADVICE = {
  cannot_hold_out: "Hold out less, choose another part, or hold out nothing.",
  not_positive_definite: "The samples may be nearly identical, or their torque may have no noise. Check the reports of the data sets.",
  damaged_data: "The file of a data set is damaged. Upload the recording again.",
  storage_full: "Delete data sets or versions that you no longer need, then retry.",
  too_long: "Train on fewer samples or with fewer iterations.",
  interrupted: "The service was stopped too often during the job. Retry.",
};

/** Why a job failed, and what to do. */
export function Failure({ error }) {
  const advice = ADVICE[error?.code] ?? "See the service's log for details, and check the reports of the data sets.";
  return html`<div class="error" role="alert"><p><strong>Training failed.</strong> ${error?.message}</p><p>${advice}</p></div>`;
}

/** The version that a job made. course: of `observe`. */
export function Result({ job, course }) {
  const version = useRead((signal) => get(path`/v1/models/${job.model}/versions/${String(job.version)}`, {}, signal), [job.model, job.version]);
  return html`<${Await} reading=${version} what="Loading the result">${(found) => html`
    <${Card} title="Result">
      <${VerdictNote} verdict=${found.verdict} />
      <p class="muted">${servingNote(job, found)}</p>
      <${Figures} version=${found} />
      <${Warnings} texts=${[...found.warnings, ...(found.lineage.holdout?.warnings ?? [])]} />
    <//>
    <${LearningCurve} version=${found} />
    <${SelectionCard} version=${found} />
    <${Chosen} job=${job} course=${course} estimator=${found.selection?.chosen ?? found.estimator} />`}<//>`;
}

function servingNote(job, { version, verdict, promotion }) {
  if (job.refresh) return "It starts serving once it predicts better than the current version.";
  if (promotion?.answers === false) return verdict.serves ? `Version ${version} is a candidate and does not serve. ${promotion.reason}` : `Version ${version} is a candidate and does not serve.`;
  const doubt = promotion && !verdict.serves ? `, although it is ${verdict.label}` : "";
  return `Version ${version} serves unless another version was chosen${doubt}.`;
}

function Figures({ version }) {
  const { verdict, lineage } = version;
  const trained = lineage.training_metrics;
  if (verdict.joints.length) return html`<${Judged} version=${version} held=${lineage.holdout} />`;
  return trained?.nmse && html`<${Trained} version=${version} figures=${trained} />`;
}

function Judged({ version, held }) {
  const samples = held?.samples ? `On ${count(held.samples)} held-out samples. ` : "";
  return html`<p class="hint">${samples}${held?.learnt && HELD_OUT_NOTE}</p><${JointVerdicts} verdict=${version.verdict} />`;
}

function Trained({ version, figures }) {
  const names = shortNames(version.joint_names);
  const columns = [
    jointColumn(names),
    { label: "RMSE", numeric: true, cell: ({ joint }) => `${number(figures.rmse[joint])} ${torqueUnit(version.joint_types[joint])}` },
    { label: "nMSE", numeric: true, cell: ({ joint }) => nmse(figures.nmse[joint]) },
    { label: "95\u00a0% coverage", numeric: true, cell: ({ joint }) => percent(figures.coverage[joint], 0) },
  ];
  return html`<${Table} columns=${columns} rows=${names.map((_name, joint) => ({ joint }))} caption=${`On ${count(figures.samples)} training samples: these figures are optimistic`} />`;
}

function jointColumn(names) {
  return { label: "Joint", cell: ({ joint }) => html`<span class="joint" style=${`--own: ${jointVar(joint)}`}>${names[joint]}</span>` };
}

/** The objective of the estimator that was chosen, if the page was open during its search. */
function Chosen({ job, course, estimator }) {
  const row = course.rows.get(estimator);
  return row?.curves.size > 0 && html`<${Card} title="Objective"><p class="hint">${OBJECTIVE_HINT}</p><${Objective} estimator=${estimator} row=${row} job=${job} /><//>`;
}
