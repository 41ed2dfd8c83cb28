// All models: their serving version, its verdict and errors.

import { pages } from "../api.js";
import { Await, Card, Empty, Heading, Link, Listing, page, useRead } from "../components.js";
import { ago, count, when } from "../format.js";
import { html, useEffect } from "../preact.js";
import { VerdictHint, verdictColumns } from "../verdicts.js";

const MAX_MODELS = 500;
const COLUMNS = [
  { label: "Model", value: (model) => model.name, cell: ({ name }) => html`<${Link} to=${address(name)}>${name}<//>` },
  ...verdictColumns((model) => serving(model)?.verdict ?? null),
  { label: "Serving version", value: (model) => model.serving_version, cell: ({ name, serving_version: version }) => html`<${Link} to=${`${address(name)}?tab=versions`}>${version === null ? "none" : `version ${version}`}<//>` },
  { label: "Estimator", value: (model) => serving(model)?.estimator, cell: (model) => serving(model)?.estimator ?? "–" },
  { label: "Created", value: (model) => serving(model)?.created_at, first: "descending", cell: (model) => time(serving(model)?.created_at) },
  { label: "Versions", numeric: true, value: (model) => model.versions.length, first: "descending", cell: (model) => count(model.versions.length) },
  { label: "Aliases", cell: (model) => aliases(model.aliases) },
  { label: "Live", cell: ({ name }) => html`<${Link} to=${`#/live/${encodeURIComponent(name)}`} label=${`Follow ${name} live`}>follow<//>` },
];

function Models({ title }) {
  useEffect(() => title("Models"), []);
  const models = useRead((signal) => pages("/v1/models", MAX_MODELS, {}, signal), []);
  return html`<${Await} reading=${models}>${(found) => (found.length ? html`<${List} models=${found} />` : html`<${None} />`)}<//>`;
}

function List({ models }) {
  const words = (model) => [model.name, serving(model)?.estimator, serving(model)?.verdict.label, aliases(model.aliases)].join(" ");
  return html`
    <${Heading} text="Models"><${Link} to="#/train" kind="primary">Train a model<//><//>
    <${Card} title="All models">
      <${Listing} columns=${COLUMNS} rows=${models} caption="Models" what=${["model", "models"]} identity=${(model) => model.name} words=${words} />
      <${VerdictHint} />
      ${models.length === MAX_MODELS && html`<p class="hint">Showing the newest ${MAX_MODELS} models.</p>`}
    <//>`;
}

function None() {
  return html`
    <${Heading} text="Models" />
    <${Empty} text="No models yet. Upload a recording of your robot, then train a model on it. This takes minutes.">
      <${Link} to="#/data" kind="primary">Upload a recording<//><${Link} to="#/train">Train a model<//>
    <//>`;
}

function serving(model) {
  return model.versions.find((each) => each.version === model.serving_version);
}

function time(at) {
  return at ? html`<time datetime=${at} title=${when(at)}>${ago(at)}</time>` : "–";
}

function address(name) {
  return `#/models/${encodeURIComponent(name)}`;
}

function aliases(named) {
  return Object.entries(named).map(([alias, version]) => `${alias} → ${version}`).join(", ") || "–";
}

export const render = page(Models);
