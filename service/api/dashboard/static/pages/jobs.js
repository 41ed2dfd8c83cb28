// All training jobs.

import { get } from "../api.js";
import { Await, Badge, Button, Card, Empty, Heading, Link, Listing, page, Progress, useRead } from "../components.js";
import { ago, percent, seconds, sentence, when } from "../format.js";
import { html, useEffect, useState } from "../preact.js";
import { VerdictHint, verdictColumns } from "../verdicts.js";
import { ACTIVE, remaining, stage } from "./job/words.js";

const PERIOD_S = 2;
const COLUMNS = [
  { label: "Model", value: (job) => job.model, cell: (job) => html`<${Link} to=${`#/jobs/${job.id}`}>${job.model}<//>` },
  { label: "State", value: (job) => job.state, cell: (job) => html`<${Badge} state=${job.state} />` },
  ...verdictColumns((job) => job.verdict),
  { label: "Result", value: (job) => job.version, cell: resultCell },
  { label: "Estimator", value: (job) => job.estimator, cell: (job) => job.estimator },
  { label: "Queued", value: (job) => job.created_at, first: "descending", cell: (job) => html`<time datetime=${job.created_at} title=${when(job.created_at)}>${ago(job.created_at)}</time>` },
];

/** The page `#/jobs`. */
function Jobs({ signal, title }) {
  useEffect(() => title("Training"), []);
  const newest = useRead((until) => get("/v1/jobs", {}, until), [], PERIOD_S);
  const [older, setOlder] = useState({ items: [], cursor: null });
  return html`
    <${Heading} text="Training"><${Link} to="#/train" kind="primary">Train a model<//><//>
    ${newest.value && newest.error && html`<p class="banner" role="status">Last update: ${when(newest.at / 1000)}. ${sentence(newest.error.message)} Retrying.</p>`}
    <${Card} title="Jobs"><${Await} reading=${newest.value ? { ...newest, error: null } : newest}>${(found) => html`<${List} newest=${found} older=${older} setOlder=${setOlder} signal=${signal} />`}<//><//>`;
}

function List({ newest, older, setOlder, signal }) {
  const ids = new Set(newest.items.map((job) => job.id));
  const jobs = [...newest.items, ...older.items.filter((job) => !ids.has(job.id))];
  const cursor = older.items.length ? older.cursor : newest.next_cursor;
  if (!jobs.length) return html`<${None} />`;
  const more = async () => {
    const found = await get("/v1/jobs", { cursor }, signal);
    setOlder({ items: [...older.items, ...found.items], cursor: found.next_cursor });
  };
  const words = (job) => [job.model, job.state, job.estimator, job.id].join(" ");
  return html`
    <${Listing} columns=${COLUMNS} rows=${jobs} caption="Jobs" what=${["job", "jobs"]} identity=${(job) => job.id} words=${words} />
    <${VerdictHint} />
    ${cursor && html`<${Button} onclick=${more}>Show older<//>`}`;
}

function None() {
  return html`<${Empty} text="No training jobs yet. Upload a recording, then train a model on it."><${Link} to="#/data" kind="button">Upload data<//><${Link} to="#/train" kind="primary">Train a model<//><//>`;
}

/** The version, the error, or the progress. */
function resultCell(job) {
  if (job.state === "failed") return job.error?.message ?? "failed";
  if (ACTIVE.has(job.state)) {
    const done = job.progress.fraction, left = remaining(job);
    return html`${percent(done, 0)}, ${stage(job)}${left && `, ${left} left`}<${Progress} fraction=${done} label=${`Progress of ${job.model}`} />`;
  }
  const version = job.version !== null && html`<${Link} to=${`#/models/${encodeURIComponent(job.model)}?version=${job.version}`}>version ${job.version}<//>`;
  const took = job.progress.elapsed_s ? `after ${seconds(Math.round(job.progress.elapsed_s))}` : "";
  return html`<span class="job-result">${version} ${took}${job.refresh && html`<br />automatic retraining`}</span>`;
}

export const render = page(Jobs);
