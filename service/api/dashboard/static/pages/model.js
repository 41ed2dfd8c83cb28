// One model: its verdict, accuracy, components, arm, versions, lineage, predictions and online learning.

import { get, pages, path } from "../api.js";
import { Await, Badge, Button, Heading, Link, page, Tabs, Term, useRead } from "../components.js";
import { when } from "../format.js";
import { JointVerdicts } from "../jointverdicts.js";
import { html, useEffect, useRef, useState } from "../preact.js";
import { notice } from "../dialogs.js";
import { Prose } from "../prose.js";
import { VerdictNote } from "../verdicts.js";
import { Warnings } from "../warnings.js";
import { Accuracy } from "./model/accuracy.js";
import { Arm } from "./model/arm.js";
import { chooseData, Choices } from "./model/choice.js";
import { Components } from "./model/parts.js";
import { Learning } from "./model/learning.js";
import { Lineage } from "./model/lineage.js";
import { Predict } from "./model/predict.js";
import { NoteText } from "./model/notes.js";
import { moveAlias, rollBack, servingButton, servingReason } from "./model/serving.js";
import { Versions } from "./model/versions.js";

/** Tabs: name in the address, label, component, selects above the tabs that it uses. */
const TABS = [
  ["accuracy", "Accuracy", Accuracy, ["version", "data"]],
  ["parts", "Components", Components, ["version", "data"]],
  ["arm", "Arm and friction", Arm, ["version"]],
  ["versions", "Versions", Versions, []],
  ["lineage", "Lineage", Lineage, ["version"]],
  ["ask", "Predict", Predict, ["version"]],
  ["learning", "Learning", Learning, []],
];

/** The page `#/models/{name}`; `?version=2&dataset=ID&part=all&tab=versions` sets the selects and the tab. */
function Model({ name, query, title }) {
  useEffect(() => title(name), [name]);
  const where = path`/v1/models/${name}`, done = useRef(null);
  const found = useRead((signal) => Promise.all([
    get(where, {}, signal), get(`${where}/aliases`, {}, signal), pages("/v1/datasets", 200, {}, signal),
  ]), [where]);
  // after a change, the notice comes with the new state, so that no button of the old state can be pressed
  useEffect(() => {
    if (done.current) notice(done.current);
    done.current = null;
  }, [found.value, found.error]);
  const changed = (text) => {
    done.current = text;
    found.reload();
  };
  return html`<${Await} reading=${found}>${([model, { items: aliases }, datasets]) => html`<${Shown} model=${model} aliases=${aliases} datasets=${datasets} where=${where} query=${query} changed=${changed} />`}<//>`;
}

function Shown({ model, aliases, datasets, where, query, changed }) {
  const [wanted, setWanted] = useState(() => ({ version: Number(query.get("version")), dataset: query.get("dataset"), part: query.get("part") }));
  const [tab, setTab] = useState(() => (TABS.some(([each]) => each === query.get("tab")) ? query.get("tab") : "accuracy"));
  const number = model.versions.some((each) => each.version === wanted.version) ? wanted.version : model.serving_version ?? model.latest_version;
  const version = useRead((signal) => get(`${where}/versions/${number}`, {}, signal), [where, number]);
  return html`<${Await} reading=${version}>${(found) => html`<${VersionPage} ...${{ model, aliases, datasets, where, version: found, wanted, setWanted, tab, setTab, changed }} />`}<//>`;
}

function VersionPage({ tab, setTab, wanted, setWanted, ...given }) {
  const { model, version, datasets } = given;
  const { dataset, part } = chooseData(version, datasets, wanted);
  const [, , Panel, needs] = TABS.find(([each]) => each === tab);
  const search = new URLSearchParams({ version: version.version, ...(dataset ? { dataset: dataset.id } : {}), ...(part === "all" ? { part } : {}), tab });
  useEffect(() => history.replaceState(null, "", `#/models/${encodeURIComponent(model.name)}?${search}`), [String(search)]);
  const view = (number, shown = tab) => {
    setWanted({ version: number, dataset: dataset?.id, part: null });
    setTab(shown);
  };
  const state = { ...given, dataset, part, view };
  return html`
    <${Header} ...${state} />
    <${Verdict} version=${version} open=${tab === "accuracy"} />
    <${Choices} ...${state} needs=${needs} setWanted=${setWanted} />
    <${Tabs} label=${`Model ${model.name}`} options=${TABS} chosen=${tab} onchoose=${setTab}>
      <${Panel} key=${[tab, version.version, dataset?.id, part].join()} ...${state} />
    <//>`;
}

function Header({ model, aliases: moved, where, version, changed }) {
  const { name, serving_version: serving, aliases } = model, shown = version.version;
  const names = Object.entries(aliases).map(([alias, number]) => `${alias} → ${number}`);
  const { note, tags } = model.versions.find((each) => each.version === shown);
  const [label, kind] = servingButton(version);
  const serve = async () => {
    if (await moveAlias({ name, where, model }, "serving", version)) changed(`Version ${shown} of ${name} is now serving.`);
  };
  const active = moved.find((each) => each.alias === "serving");
  const back = async () => {
    const done = await rollBack({ name, where }, active);
    if (done) changed(done);
  };
  const reason = active ? servingReason(active, model.versions) : "No version is serving.";
  return html`
    <${Heading} text=${name}>
      <div class="actions">
        ${shown === serving ? html`<${Badge} state="serving" />` : html`<${Button} key=${label} kind=${kind} onclick=${serve}>${label}<//>`}
        <${Link} to=${`#/live/${encodeURIComponent(name)}`}>Follow live<//>
        <${Link} to=${`#/train?model=${encodeURIComponent(name)}`}>Train a new version<//>
      </div>
    <//>
    <p class="muted">${[shown === serving ? `Version ${shown}` : `Viewing version ${shown}`, version.estimator, `created ${when(version.created_at)}`, ...names].join(" · ")}</p>
    <p class="muted actions"><span><${Prose} text=${reason} /></span> ${active?.previous && html`<${Button} key=${active.previous} onclick=${back}>Roll back to version ${active.previous}<//>`}</p>
    ${(note || tags.length > 0) && html`<p><${NoteText} note=${note} tags=${tags} /></p>`}`;
}

function Verdict({ version, open }) {
  const { verdict, promotion, warnings } = version;
  return html`<section class="card" aria-label="Verdict">
    <${VerdictNote} verdict=${verdict} />
    ${promotion?.answers && !verdict.serves && html`<p class="hint">Version ${version.version} was promoted, although it is ${verdict.label}.</p>`}
    ${promotion && !promotion.answers && verdict.serves && html`<p class="banner" role="note"><strong>Version ${version.version} is a <${Term} of="candidate">candidate<//>.</strong> ${promotion.reason}</p>`}
    <${Warnings} texts=${warnings} />
    ${verdict.joints.length > 0 && html`<details class="by-joint" open=${open}><summary>Joints</summary><${JointVerdicts} verdict=${verdict} /></details>`}
  </section>`;
}

export const render = page(Model);
