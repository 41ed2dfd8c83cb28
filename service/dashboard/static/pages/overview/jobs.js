// Jobs that run or wait, with their progress; the last ones that ended where none does.

import { h, replace } from "../../dom.js";
import { ago, seconds } from "../../format.js";
import { badge, card, link, progress } from "../../ui.js";
import { changed } from "./follow.js";

const ENDED = 3;

/** A board that keeps its rows, and with them the focus, while their progress changes: call it with the jobs' page. */
export function jobBoard(place) {
  const rows = new Map();
  return (jobs) => {
    const active = jobs.filter((job) => job.state === "running" || job.state === "queued");
    const shown = [...active, ...jobs.filter((job) => !active.includes(job)).slice(0, ENDED)];
    if (changed(place, shown.map((job) => [job.id, job.state]))) {
      for (const id of rows.keys()) if (!shown.some((job) => job.id === id)) rows.delete(id);
      for (const job of shown) if (rows.get(job.id)?.state !== job.state) rows.set(job.id, row(job));
      const list = h("ul", { class: "rows" }, shown.map((job) => rows.get(job.id).element));
      replace(place, shown.length ? card("Training", list, h("p", {}, link("All jobs", "#/jobs"))) : null);
    }
    for (const job of shown) rows.get(job.id).update(job);
  };
}

function row(job) {
  const about = h("span", { class: "muted" });
  const bar = job.state === "running" ? progress(0, `Progress of ${job.model}`) : null;
  const element = h(
    "li",
    {},
    h("div", { class: "row" }, badge(job.state), h("a", { href: `#/jobs/${job.id}` }, `${job.model}, ${job.estimator}`), about),
    bar,
  );
  return {
    element,
    state: job.state,
    update(now) {
      about.textContent = said(now);
      if (bar) bar.value = now.progress.fraction;
    },
  };
}

function said(job) {
  const { stage, remaining_s: left } = job.progress;
  if (job.state === "queued") return `waiting, asked for ${ago(job.created_at)}`;
  if (job.state === "running") return left ? `${stage}, at most about ${seconds(left)} more` : stage;
  if (job.state === "succeeded") return `made version ${job.version}, ${ago(job.finished_at)}`;
  return `${job.error?.message ?? ""} ${ago(job.finished_at)}`.trim();
}
