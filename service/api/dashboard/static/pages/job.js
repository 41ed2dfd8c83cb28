// One training job: progress, cancel, retry, result.

import { get, path, post } from "../api.js";
import { Await, Badge, Button, Card, Facts, Heading, Link, page, Progress, useRead } from "../components.js";
import { count, percent, seconds, sentence, when } from "../format.js";
import { html, useCallback, useEffect, useState } from "../preact.js";
import { confirm, notice } from "../dialogs.js";
import { observe } from "./job/course.js";
import { follow } from "./job/following.js";
import { Objective, OBJECTIVE_HINT } from "./job/objective.js";
import { Failure, Result } from "./job/outcome.js";
import { LastSteps, Steps } from "./job/steps.js";
import { ACTIVE, heldOut, remaining, stage } from "./job/words.js";

const STALE_AFTER_S = 5;
const MAX_NAMES = 10;
const TRIGGERS = { asked: "on request", novelty: "triggered by novel motion", linearisation: "triggered by drift past the linearisation" };

/** The page `#/jobs/{id}`. */
function JobPage({ id, title }) {
  const { value, error, trouble, at, update } = useFollowed(id);
  useEffect(() => title(value ? `Training ${value.job.model}` : ""), [value?.job.model]);
  return html`<${Await} reading=${{ value, error, reload: () => location.reload() }}>${({ job, course }) => html`
    <${Heading} text=${`Training ${job.model}`}><${Actions} job=${job} update=${update} /><//>
    ${job.state === "succeeded" && html`<${Result} job=${job} course=${course} />`}
    ${job.state === "failed" && html`<${Failure} error=${job.error} />`}
    ${ACTIVE.has(job.state) && html`<${Stale} job=${job} trouble=${trouble} at=${at} />`}
    ${job.state !== "succeeded" && html`<${Course} job=${job} course=${course} />`}
    <${Request} job=${job} />
    <${History} job=${job} />`}<//>`;
}

/** Follow a job to its end. Returns {value: {job, course}, error, trouble, at, update(job)}. */
function useFollowed(id) {
  const [state, setState] = useState({ value: null, error: null, trouble: "", at: 0 });
  const update = useCallback((job) => setState({ value: { job, course: observe(job) }, error: null, trouble: "", at: Date.now() }), [id]);
  useEffect(() => {
    const stop = new AbortController();
    const { signal } = stop;
    const onTrouble = (trouble) => setState((last) => ({ ...last, trouble }));
    const watch = async () => {
      const job = await get(path`/v1/jobs/${id}`, {}, signal);
      update(job);
      if (ACTIVE.has(job.state)) await follow(id, { onJob: update, onTrouble, signal });
    };
    watch().catch((error) => signal.aborted || setState((last) => ({ ...last, error }))); // also if the job is deleted
    return () => stop.abort();
  }, [id]);
  return { ...state, update };
}

function Actions({ job, update }) {
  const cancel = async () => {
    if (!(await confirm(`Cancel the training of ${job.model}? Its progress is lost.`, "Cancel training"))) return;
    update(await post(path`/v1/jobs/${job.id}/cancel`));
  };
  const retry = async () => {
    const again = await post(path`/v1/jobs/${job.id}/retry`);
    notice("A new job with the same request is queued.");
    location.hash = `#/jobs/${again.id}`;
  };
  if (ACTIVE.has(job.state)) return html`<${Button} key="cancel" kind="danger" onclick=${cancel}>Cancel training<//>`;
  if (job.state === "succeeded") return html`<${Link} kind="primary" to=${`#/models/${encodeURIComponent(job.model)}?version=${job.version}`}>View version ${job.version}<//>`;
  return html`<${Button} key="retry" kind="primary" onclick=${retry}>Retry<//>`;
}

/** State, steps and objective of a job that has not succeeded. */
function Course({ job, course }) {
  const active = ACTIVE.has(job.state);
  const rows = [...course.rows];
  return html`<${Card} title="Progress">
    <p role="status"><${Badge} state=${job.state} /> ${active ? stage(job) : job.history.at(-1)?.message}</p>
    ${active && html`<${Progress} fraction=${job.progress.fraction} label="Training progress" /><p class="muted timing">${timing(job)}</p>`}
    ${rows.map(([estimator, row]) => html`<section class="tried" key=${estimator} aria-label=${estimator}>
      <h3>${estimator}</h3>
      <${Steps} estimator=${estimator} course=${course} active=${active} />
      <${Objective} estimator=${estimator} row=${row} job=${job} />
    </section>`)}
    ${rows.length > 0 && active && html`<section class="tried" aria-label="Version"><h3>Version</h3><${LastSteps} course=${course} /></section>`}
    ${rows.some(([, row]) => row.curves.size) && html`<p class="hint">${OBJECTIVE_HINT}${course.late && " This page was opened during the job: earlier steps and iterations are missing."}</p>`}
  <//>`;
}

function timing(job) {
  const { fraction, elapsed_s: elapsed } = job.progress;
  if (job.state === "queued") return "Not started yet.";
  const left = remaining(job);
  return [percent(fraction, 0), elapsed < 1 ? "started just now" : `${seconds(Math.round(elapsed))} so far`, left ? `${left} left` : "time left unknown"].join(" · ");
}

/** A banner if no update has arrived for a while. */
function Stale({ job, trouble, at }) {
  const [now, setNow] = useState(Date.now());
  useEffect(() => {
    const timer = setInterval(() => setNow(Date.now()), 1000);
    return () => clearInterval(timer);
  }, []);
  const silent = job.state === "running" && now - at > 1000 * STALE_AFTER_S;
  const text = trouble ? sentence(trouble) : "No updates have arrived for a while.";
  return html`<p class="banner" role="status" hidden=${!trouble && !silent}>${(trouble || silent) && `${text} Last update: ${when(at / 1000)}. Retrying.`}</p>`;
}

function Request({ job }) {
  const names = useRead((signal) => readNames(job.datasets, signal), [job.id]);
  const sets = job.datasets.map((id, index) => html`${index > 0 && ", "}<${Link} to=${`#/data/${id}`}>${names.value?.[id] ?? id}<//>`);
  const pairs = [
    ["Model", job.version === null ? job.model : html`<${Link} to=${`#/models/${encodeURIComponent(job.model)}`}>${job.model}<//>`], // the model may not exist before
    ["Estimator", job.estimator],
    ["Robot", job.robot ?? "none"],
    ["Data sets", sets.length ? sets : "–"],
    ["Held out", heldOut(job.holdout)],
    ...(job.base ? [["Started from", job.base]] : []),
    ...(job.refresh ? [["Retraining of", `version ${job.refresh.version}, ${TRIGGERS[job.refresh.trigger]}`]] : []),
    ...(job.retry_of ? [["Retry of", html`<${Link} to=${`#/jobs/${job.retry_of}`}>an earlier job<//>`]] : []),
    ...(ACTIVE.has(job.state) || job.progress.elapsed_s < 1 ? [] : [["Duration", seconds(Math.round(job.progress.elapsed_s))]]),
  ];
  return html`<${Card} title="Request"><${Facts} pairs=${pairs} /><//>`;
}

function History({ job }) {
  const facts = [["ID", html`<code>${job.id}</code>`], ["Attempts", count(job.attempts)], ...(job.request_id ? [["Request ID", html`<code>${job.request_id}</code>`]] : [])];
  return html`<details class="card"><summary>History</summary>
    <ol>${job.history.map((entry) => html`<li key=${`${entry.at} ${entry.state}`}><span class="muted">${when(entry.at)}</span> <${Badge} state=${entry.state} /> ${entry.message}</li>`)}</ol>
    <${Facts} pairs=${facts} />
  </details>`;
}

/** Read the names of data sets; a deleted one has none. */
async function readNames(ids, signal) {
  const found = await Promise.all(ids.slice(0, MAX_NAMES).map((id) => get(path`/v1/datasets/${id}`, {}, signal).catch(() => null)));
  return Object.fromEntries(found.filter(Boolean).map((each) => [each.id, each.name]));
}

export const render = page(JobPage);
