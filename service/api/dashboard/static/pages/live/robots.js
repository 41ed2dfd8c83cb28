// List of the streaming robots with their models and states.

import { get, pages, path } from "../../api.js";
import { Await, Badge, Card, Empty, Heading, Link, Table, useRead } from "../../components.js";
import { ago, kilograms, percent, seconds, sentence } from "../../format.js";
import { html } from "../../preact.js";
import { VerdictBadge } from "../../verdicts.js";

const PERIOD_S = 3;
const MAX_MODELS = 100;
const MAX_DETAILED = 20; // models to read streams of, the most recent first
const LIVE_S = 10;
const COLUMNS = [
  { label: "Robot", cell: ({ model, stream }) => html`<${Link} to=${address(model.name)}>${stream ?? "several"}<//>` },
  { label: "State", cell: state },
  { label: "Model", cell: ({ model }) => html`<${Link} to=${address(model.name)}>${model.name}<//>` },
  { label: "Verdict", cell: ({ model }) => html`<${VerdictBadge} verdict=${model.verdict} />` },
  { label: "Last row", cell: ({ heard }) => (heard === null ? "–" : ago(heard)) },
  { label: "Learning", cell: ({ model: { lag_s: lag } }) => (lag === null ? "–" : lag < 1 ? "up to date" : `${seconds(lag)} behind`) },
  { label: "95 % coverage", numeric: true, cell: coverage },
  { label: "Payload", cell: payload },
  { label: "Last alarm", cell: ({ model: { alarm } }) => (alarm ? `${alarm.kind}, ${ago(alarm.at)}` : "none") },
];

/** The list, read again while the page is visible. */
export function Robots() {
  const reading = useRead(async (signal) => {
    const models = await pages("/v1/overview", MAX_MODELS, {}, signal);
    return { models, found: await streams(models, signal) };
  }, [], PERIOD_S);
  const { value, error } = reading;
  return html`<${Heading} text="Live" />
    ${value && error && html`<p class="banner" role="status">Out of date. ${sentence(error.message)} Retrying.</p>`}
    <${Await} reading=${value ? { ...reading, error: null } : reading}>${(seen) => html`<${Shown} ...${seen} />`}<//>`;
}

function Shown({ models, found }) {
  if (!models.length) return html`<${Empty} text="No models yet. Upload a recording of your robot, then train a model on it."><${Link} to="#/data" kind="primary">Upload a recording<//><//>`;
  const silent = models.filter((each) => each.idle_s === null);
  const none = html`No streams yet. Try a simulated robot: <code>lipserve stream ${models[0].name} --simulate panda --learn</code>`;
  return html`
    ${found.length ? html`<${Card} title="Robots"><${Table} columns=${COLUMNS} rows=${found} caption="Coverage: smallest of the joints in the last hour" identity=${({ model, stream }) => `${model.name}/${stream}`} /><//>` : html`<${Empty} text=${none} />`}
    ${silent.length > 0 && html`<${Card} title="Models without a stream"><ul class="names">${silent.map(({ name }) => html`<li key=${name}><${Link} to=${address(name)}>${name}<//></li>`)}</ul><//>`}`;
}

/** Return the address of a model's live page. */
export function address(name) {
  return `#/live/${encodeURIComponent(name)}`;
}

/** Read the streams of the models, {model, stream, heard}, the most recent first. heard: time of the last row, ISO 8601; null if unknown. */
async function streams(models, signal) {
  const heard = models.filter((each) => each.idle_s !== null).sort((one, other) => one.idle_s - other.idle_s);
  const found = await Promise.all(heard.slice(0, MAX_DETAILED).map(async (model) => {
    const where = path`/v1/models/${model.name}`;
    try {
      const { status } = await get(`${where}/learning`, {}, signal);
      return await Promise.all(status.streams.map(async ({ stream_id: stream }) => {
        const { items } = await get(`${where}/observations`, { stream_id: stream, limit: 1 }, signal);
        return { model, stream, heard: items[0]?.received_at ?? null };
      }));
    } catch (error) {
      if (error.name !== "ApiError" || error.status !== 404) throw error;
      return []; // the model was deleted meanwhile
    }
  }));
  const known = [...found.flat(), ...heard.slice(MAX_DETAILED).map((model) => ({ model, stream: null, heard: null }))];
  return known.sort((one, other) => Date.parse(other.heard ?? 0) - Date.parse(one.heard ?? 0));
}

function state({ model, stream, heard }) {
  const load = model.payloads?.find((each) => each.stream_id === stream);
  const live = heard !== null && Date.now() - Date.parse(heard) < 1000 * LIVE_S;
  if (model.held) return html`<${Badge} state="paused" />`;
  if (model.failure) return html`<${Badge} state="learning failed" kind="bad" />`;
  if (!live) return html`<${Badge} state="idle" />`;
  return load?.state === "contact" ? html`<${Badge} state="contact" kind="warn" />` : html`<${Badge} state="live" kind="good" />`;
}

function payload({ model, stream }) {
  const load = model.payloads?.find((each) => each.stream_id === stream);
  return load?.mass ? kilograms(load.mass) : "–";
}

function coverage({ model: { recent } }) {
  const known = (recent?.coverage ?? []).filter((each) => each !== null);
  return known.length ? percent(Math.min(...known)) : "–";
}
