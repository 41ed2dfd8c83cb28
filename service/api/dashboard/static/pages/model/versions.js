// Versions and aliases: serve, roll back, export, delete, compare.

import { del, path } from "../../api.js";
import { Badge, Button, Card, Choice, Field, Listing, Table } from "../../components.js";
import { ago, when } from "../../format.js";
import { html, useRef, useState } from "../../preact.js";
import { confirm } from "../../dialogs.js";
import { VerdictHint, verdictColumns } from "../../verdicts.js";
import { Compare } from "./compare.js";
import { exportVersion } from "./export.js";
import { Note } from "./notes.js";
import { moveAlias, rollBack, servingButton } from "./serving.js";

/** The tab. */
export function Versions(state) {
  return html`
    <${Card} title="Versions"><${List} ...${state} /><${VerdictHint} /><//>
    <${Card} title="Aliases" term="alias"><${Aliases} ...${state} /><${AliasForm} ...${state} /><//>
    ${state.model.versions.length > 1 && html`<${Card} title="Compare versions"><${Compare} ...${state} /><//>`}`;
}

function List({ model, where, aliases, version, view, changed }) {
  const { name, serving_version: serving } = model;
  const named = (number) => aliases.filter((each) => each.version === number && each.alias !== "serving").map((each) => each.alias);
  const serve = async (each) => {
    if (await moveAlias({ name, where, model }, "serving", each)) changed(`Version ${each.version} of ${name} is now serving.`);
  };
  const remove = async (number) => {
    if (!(await confirm(`Delete version ${number} of ${name}? This cannot be undone.`, `Delete version ${number}`))) return;
    await del(`${where}/versions/${number}`);
    changed(`Version ${number} deleted.`);
  };
  const action = (number, text, onclick, kind = "") => html`<${Button} key=${text} kind=${kind} label=${`${text}: version ${number}`} onclick=${onclick}>${text}<//>`;
  const actions = (each) => {
    const number = each.version, away = number !== serving;
    return html`<div class="actions">
      ${action(number, "View", () => view(number, "accuracy"))}
      ${away && action(number, each.verdict.serves ? "Serve" : "Serve anyway", () => serve(each), servingButton(each)[1])}
      ${action(number, "Export", () => exportVersion(name, number))}
      ${away && !named(number).length && action(number, "Delete", () => remove(number), "danger")}
    </div>`;
  };
  const label = ({ version: number }) => html`${number} ${number === serving && html`<${Badge} state="serving" /> `}${named(number).map((alias) => html`<${Badge} state=${alias} kind="plain" /> `)}${number === version.version && html`<span class="muted">viewing</span>`}`;
  const columns = [
    { label: "Version", value: (each) => each.version, first: "descending", cell: label },
    ...verdictColumns((each) => each.verdict),
    { label: "Estimator", value: (each) => each.estimator, cell: (each) => each.estimator },
    { label: "Created", value: (each) => each.created_at, first: "descending", cell: (each) => html`<time datetime=${each.created_at} title=${when(each.created_at)}>${ago(each.created_at)}</time>` },
    { label: "Note", cell: (each) => html`<${Note} where=${where} version=${each} changed=${changed} />` },
    { label: "Actions", cell: actions },
  ];
  const words = (each) => [`version ${each.version}`, each.estimator, each.note, ...each.tags, each.verdict.label, ...named(each.version)].join(" ");
  return html`<${Listing} columns=${columns} rows=${[...model.versions].reverse()} caption="Versions, newest first" what=${["version", "versions"]} identity=${(each) => each.version} words=${words} minRows=${4} />`;
}

function Aliases({ model: { name }, where, aliases, changed }) {
  const back = async (each) => {
    const done = await rollBack({ name, where }, each);
    if (done) changed(done);
  };
  const remove = async ({ alias, version }) => {
    if (!(await confirm(`Remove the alias “${alias}”? Queries that name it will fail. Version ${version} is kept.`, "Remove alias"))) return;
    await del(path`/v1/models/${name}/aliases/${alias}`);
    changed(`Alias ${alias} removed.`);
  };
  const actions = (each) => html`<div class="actions">
    ${each.previous !== null && html`<${Button} label=${`Roll back: ${each.alias}`} onclick=${() => back(each)}>Roll back<//>`}
    ${each.alias !== "serving" && html`<${Button} kind="danger" label=${`Remove: ${each.alias}`} onclick=${() => remove(each)}>Remove<//>`}
  </div>`;
  const columns = [
    { label: "Alias", cell: (each) => `${each.alias} → ${each.version}` },
    { label: "Actions", cell: actions },
    { label: "Previous", cell: (each) => (each.previous === null ? "–" : `version ${each.previous}`) },
    { label: "Changed", cell: (each) => when(each.changed_at) },
  ];
  return html`<${Table} columns=${columns} rows=${aliases} identity=${(each) => each.alias} caption="“serving” is used for queries that name no version; other aliases for queries that name them" />`;
}

function AliasForm({ where, model, changed }) {
  const newest = [...model.versions].reverse();
  const [alias, setAlias] = useState(""), [number, setNumber] = useState(model.serving_version ?? model.latest_version), form = useRef(null);
  const set = async () => {
    if (!form.current.reportValidity()) return;
    const chosen = alias.trim();
    if (await moveAlias({ name: model.name, where, model }, chosen, model.versions.find((each) => each.version === number))) changed(`${chosen} → version ${number}`);
  };
  const input = (attributes) => html`<input ...${attributes} type="text" required pattern="[a-z][a-z0-9._\\-]{0,63}" placeholder="production" autocomplete="off" spellcheck=${false} value=${alias} onInput=${(event) => setAlias(event.target.value)} />`;
  return html`<details>
    <summary>Create or move an alias</summary>
    <form class="grid" ref=${form} onSubmit=${(event) => event.preventDefault()}>
      <${Field} label="Alias" hint="A lower-case letter, then lower-case letters, digits, dots and hyphens." input=${input} />
      <${Choice} label="Points to" options=${newest.map((each) => [String(each.version), `version ${each.version}`])} value=${String(number)} onchange=${(value) => setNumber(Number(value))} />
    </form>
    <${Button} onclick=${set}>Set alias<//>
  </details>`;
}
