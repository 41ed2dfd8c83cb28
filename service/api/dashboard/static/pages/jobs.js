// All training jobs.

import { get } from "../api.js";
import { h, refresh, replace } from "../dom.js";
import { ago, percent, seconds, sentence, when } from "../format.js";
import { listing } from "../tables.js";
import { badge, button, card, empty, heading, link, progress, repeat } from "../ui.js";
import { ACTIVE, remaining, stage } from "./job/words.js";
import { QUALITY_HINT, qualityColumns } from "./quality.js";

/** The page `#/jobs`. */
export async function render(view, params, { signal, title }) {
  title("Training");
  const list = h("div", {});
  const table = listing(COLUMNS, {
    caption: "Jobs",
    what: ["job", "jobs"],
    key: (job) => job.id,
    words: (job) => [job.model, job.state, job.estimator, job.id].join(" "),
  });
  const hint = h("p", { class: "hint" }, QUALITY_HINT);
  const stale = h("p", { class: "banner", role: "status", hidden: true });
  let older = [];
  let cursor = null;
  let seen = "";

  const draw = (newest) => {
    const ids = new Set(newest.map((job) => job.id));
    const jobs = [...newest, ...older.filter((job) => !ids.has(job.id))];
    if (jobs.length) table.show(jobs);
    refresh(list, jobs.length ? [table.element, hint] : emptyState(), cursor ? more : null);
  };
  let newest = [];
  const more = button("Show older", async () => {
    const page = await get("/v1/jobs", { cursor }, signal);
    older = [...older, ...page.items];
    cursor = page.next_cursor;
    draw(newest);
  });
  const load = async () => {
    const page = await get("/v1/jobs", {}, signal);
    if (!older.length) cursor = page.next_cursor;
    newest = page.items;
    const now = JSON.stringify([newest, Math.floor(Date.now() / 30_000)]); // also redraw for texts such as “2 min ago”
    if (now !== seen) draw(newest);
    seen = now;
  };

  await load();
  let read = Date.now();
  replace(view, heading("Training", link("Train a model", "#/train", "primary")), stale, card("Jobs", list));
  repeat(
    2,
    async () => {
      try {
        await load();
        read = Date.now();
        stale.hidden = true;
      } catch (error) {
        if (error.name === "AbortError") return;
        stale.hidden = false;
        stale.textContent = `Last update: ${when(read / 1000)}. ${sentence(error.message)} Retrying.`;
      }
    },
    signal,
  );
}

const COLUMNS = [
  { label: "Model", value: (job) => job.model, cell: (job) => link(job.model, `#/jobs/${job.id}`) },
  { label: "State", value: (job) => job.state, cell: (job) => badge(job.state) },
  ...qualityColumns((job) => job.verdict).map((column) => ({
    ...column,
    cell: (job) => (job.state === "succeeded" ? column.cell(job) : "–"),
  })),
  { label: "Result", value: (job) => job.version, cell: (job) => (job.version === null ? "–" : link(`version ${job.version}`, `#/models/${job.model}?version=${job.version}`)) },
  { label: "Progress", cell: progressCell },
  { label: "Estimator", value: (job) => job.estimator, cell: (job) => job.estimator },
  { label: "Recordings", numeric: true, value: (job) => job.datasets.length, cell: (job) => job.datasets.length },
  { label: "Queued", value: (job) => job.created_at, first: "descending", cell: (job) => h("time", { datetime: job.created_at, title: when(job.created_at) }, ago(job.created_at)) },
];

function progressCell(job) {
  if (job.state === "failed") return job.error?.message ?? "failed";
  if (!ACTIVE.has(job.state)) {
    const took = job.progress.elapsed_s ? `took ${seconds(job.progress.elapsed_s)}` : "";
    return [took, job.refresh ? "automatic retraining" : ""].filter(Boolean).join(", ");
  }
  const done = job.progress.fraction;
  return [`${percent(done, 0)}, ${stage(job)}`, remaining(job) ? `, ${remaining(job)} left` : "", progress(done, `Progress of ${job.model}`)];
}

function emptyState() {
  return empty("No training jobs yet. Upload a recording, then train a model on it.", link("Upload data", "#/data"), link("Train a model", "#/train", "primary"));
}
