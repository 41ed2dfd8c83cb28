// Overview: models, training jobs, health of the service, first steps.

import { get } from "../api.js";
import { ErrorBox, Heading, Link, Loading, page, useRead } from "../components.js";
import { when } from "../format.js";
import { html, useEffect } from "../preact.js";
import { Health } from "./overview/health.js";
import { Jobs } from "./overview/jobs.js";
import { Models } from "./overview/models.js";
import { Steps } from "./overview/steps.js";

const PERIOD_S = 2;
const MAX_MODELS = 24;

/** The page `#/`. */
function Overview({ title }) {
  useEffect(() => title("Overview"), []);
  const jobs = useRead((signal) => get("/v1/jobs", {}, signal), [], PERIOD_S);
  const models = useRead((signal) => get("/v1/overview", { limit: MAX_MODELS }, signal), [], PERIOD_S);
  const data = useRead((signal) => get("/v1/datasets", { limit: 1 }, signal), []);
  const readings = [models, jobs, data];
  const retry = () => readings.filter((each) => each.error).forEach((each) => each.reload());
  return html`
    <${Heading} text="Overview"><${Link} to="#/data" kind="button">Upload a recording<//><${Link} to="#/train" kind="primary">Train a model<//><//>
    <${Health} period=${PERIOD_S} />
    <${Stale} reading=${readings.find((each) => each.error)} retry=${retry} />
    ${readings.every((each) => each.value) && html`<${Steps} hasData=${data.value.items.length > 0} models=${models.value.items} jobs=${jobs.value.items} />`}
    ${models.value ? html`<${Models} shown=${models.value} />` : !models.error && html`<${Loading} />`}
    ${jobs.value && html`<${Jobs} jobs=${jobs.value.items} />`}`;
}

/** One error of the readings, and the time of the last values. */
function Stale({ reading, retry }) {
  if (!reading) return null;
  return html`<${ErrorBox} error=${reading.error} retry=${retry} />${reading.at && html`<p class="hint">Last update: ${when(reading.at / 1000)}.</p>`}`;
}

export const render = page(Overview);
