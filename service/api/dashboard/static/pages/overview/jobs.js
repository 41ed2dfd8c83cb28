// Queued and running jobs with their progress, and the last finished ones.

import { h, refresh } from "../../dom.js";
import { ago, seconds } from "../../format.js";
import { badge, card, link, progress } from "../../ui.js";

const MAX_FINISHED = 3;

/** Show the jobs. */
export function jobBoard(place, jobs) {
  const active = jobs.filter((job) => job.state === "running" || job.state === "queued");
  const shown = [...active, ...jobs.filter((job) => !active.includes(job)).slice(0, MAX_FINISHED)];
  const list = h("ul", { class: "rows" }, shown.map(row));
  refresh(place, shown.length ? card("Training", list, h("p", {}, link("All jobs", "#/jobs"))) : null);
}

function row(job) {
  return h(
    "li",
    { "data-key": job.id },
    h("div", { class: "row" }, badge(job.state), link(`${job.model}, ${job.estimator}`, `#/jobs/${job.id}`), h("span", { class: "muted" }, status(job))),
    job.state === "running" ? progress(job.progress.fraction, `Progress of ${job.model}`) : null,
  );
}

function status(job) {
  const { stage, remaining_s: left } = job.progress;
  if (job.state === "queued") return `queued ${ago(job.created_at)}`;
  if (job.state === "running") return left ? `${stage}, up to ${seconds(left)} left` : stage;
  if (job.state === "succeeded") return `version ${job.version}${job.verdict ? `: ${job.verdict.label}` : ""}, ${ago(job.finished_at)}`;
  return `${job.error?.message ?? ""} ${ago(job.finished_at)}`.trim();
}
