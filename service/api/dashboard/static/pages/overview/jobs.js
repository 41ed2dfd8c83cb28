// Jobs that run or wait, with their progress; the last ones that ended where none does.

import { mean } from "../../charts.js";
import { h, refresh } from "../../dom.js";
import { ago, nmse, percent, seconds } from "../../format.js";
import { badge, card, link, progress } from "../../ui.js";

const ENDED = 3;

/** Show what the page of jobs tells. */
export function jobBoard(place, jobs) {
  const active = jobs.filter((job) => job.state === "running" || job.state === "queued");
  const shown = [...active, ...jobs.filter((job) => !active.includes(job)).slice(0, ENDED)];
  const list = h("ul", { class: "rows" }, shown.map(row));
  refresh(place, shown.length ? card("Training", list, h("p", {}, link("All jobs", "#/jobs"))) : null);
}

function row(job) {
  return h(
    "li",
    { "data-key": job.id },
    h("div", { class: "row" }, badge(job.state), link(`${job.model}, ${job.estimator}`, `#/jobs/${job.id}`), h("span", { class: "muted" }, said(job))),
    job.state === "running" ? progress(job.progress.fraction, `Progress of ${job.model}`) : null,
  );
}

function said(job) {
  const { stage, remaining_s: left } = job.progress;
  if (job.state === "queued") return `waiting, queued ${ago(job.created_at)}`;
  if (job.state === "running") return left ? `${stage}, at most about ${seconds(left)} left` : stage;
  if (job.state === "succeeded") return `made version ${job.version}${judged(job)}, ${ago(job.finished_at)}`;
  return `${job.error?.message ?? ""} ${ago(job.finished_at)}`.trim();
}

function judged({ quality }) {
  return quality ? `: nMSE ${nmse(mean(quality.nmse))}, ${percent(mean(quality.coverage), 0)} in the 95\u00a0% band` : "";
}
