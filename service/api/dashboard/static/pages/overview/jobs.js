// Queued and running jobs with their progress, and the last finished ones.

import { Badge, Card, Link, Progress } from "../../components.js";
import { ago, seconds } from "../../format.js";
import { html } from "../../preact.js";
import { ACTIVE, stage } from "../job/words.js";

const MAX_FINISHED = 3;

/** The active jobs and the last finished ones. */
export function Jobs({ jobs }) {
  const active = jobs.filter((job) => ACTIVE.has(job.state));
  const shown = [...active, ...jobs.filter((job) => !ACTIVE.has(job.state)).slice(0, MAX_FINISHED)];
  if (!shown.length) return null;
  return html`<${Card} title="Training">
    <ul class="rows">${shown.map((job) => html`<${Row} key=${job.id} job=${job} />`)}</ul>
    <p><${Link} to="#/jobs">All jobs<//></p>
  <//>`;
}

function Row({ job }) {
  return html`<li data-key=${job.id}>
    <div class="row"><${Badge} state=${job.state} /> <${Link} to=${`#/jobs/${job.id}`}>${job.model}, ${job.estimator}<//> <span class="muted">${status(job)}</span></div>
    ${job.state === "running" && html`<${Progress} fraction=${job.progress.fraction} label=${`Progress of ${job.model}`} />`}
  </li>`;
}

function status(job) {
  const left = job.progress.remaining_s;
  if (job.state === "queued") return `queued ${ago(job.created_at)}`;
  if (job.state === "running") return left ? `${stage(job)}, up to ${seconds(Math.ceil(left))} left` : stage(job);
  if (job.state === "succeeded") return `version ${job.version}${job.verdict ? `: ${job.verdict.label}` : ""}, ${ago(job.finished_at)}`;
  return `${job.error?.message ?? ""} ${ago(job.finished_at)}`.trim();
}
