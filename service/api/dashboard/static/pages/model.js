// One model: how well it predicts, what it has learnt, its versions, and a form to ask it.

import { get, pages, path, put } from "../api.js";
import { h, refresh, replace } from "../dom.js";
import { when } from "../format.js";
import { badge, button, errorBox, heading, link, loading, notice, tabs } from "../ui.js";
import { warned } from "./data/prose.js";
import { accuracy } from "./model/accuracy.js";
import { arm } from "./model/arm.js";
import { ask } from "./model/ask.js";
import { chooser, firstChoice } from "./model/choice.js";
import { learning } from "./model/learning.js";
import { lineage } from "./model/lineage.js";
import { parts } from "./model/parts.js";
import { mayAnswer, promoted } from "./model/promotion.js";
import { confirmServing } from "./model/serving.js";
import { versions } from "./model/versions.js";

/** Each tab: its name in the address, its label, what shows it, and what of the choice above the tabs it goes by. */
const TABS = [
  ["accuracy", "Accuracy", accuracy, { data: true, version: true }],
  ["parts", "Parts and friction", parts, { data: true, version: true }],
  ["arm", "Arm", arm, { version: true }],
  ["versions", "Versions", versions, {}],
  ["lineage", "Lineage", lineage, { version: true }],
  ["ask", "Ask", ask, { version: true }],
  ["learning", "Learning", learning, {}],
];

/** The page `#/models/{name}`; `?version=2&dataset=ID&part=held_out&tab=versions` chooses beforehand. */
export async function render(view, { name, query }, { signal, title }) {
  title(name);
  const where = path`/v1/models/${name}`;
  const [model, datasets] = await Promise.all([get(where, {}, signal), pages("/v1/datasets", 200, {}, signal)]);
  const asked = Number(query.get("version"));
  const number = model.versions.some((each) => each.version === asked) ? asked : shownFirst(model);
  const version = await get(`${where}/versions/${number}`, {}, signal);
  const state = { name, where, model, version, datasets, ...firstChoice(version, datasets, query) };
  state.tab = TABS.some(([tab]) => tab === query.get("tab")) ? query.get("tab") : "accuracy";

  const choice = h("div", { class: "grid" }), panel = h("div", { role: "tabpanel" });
  let left = new AbortController();
  signal.addEventListener("abort", () => left.abort());

  const show = async () => {
    left.abort();
    left = new AbortController();
    const mine = left.signal;
    const [tab, label, draw, needs] = TABS.find(([each]) => each === state.tab);
    remember(state);
    updateTop();
    choose(needs);
    panel.setAttribute("aria-label", label);
    const inner = h("div", { dataset: { tab } });
    replace(panel, inner);
    try {
      await draw(inner, state, { signal: mine, reload, select, show });
    } catch (error) {
      if (mine.aborted || error.name === "AbortError") return;
      if (error.name !== "ApiError") console.error(error);
      replace(inner, errorBox(error, show));
    }
  };
  /** Look at another version. */
  const select = async (chosen, tab = state.tab) => {
    replace(panel, loading());
    state.version = await get(`${where}/versions/${chosen}`, {}, signal);
    Object.assign(state, firstChoice(state.version, datasets, new URLSearchParams({ dataset: state.dataset ?? "" })));
    if (tab !== state.tab) list.querySelector(`[data-name="${tab}"]`).click();
    else await show();
  };
  /** Read the model again, after something about it was changed here. */
  const reload = async () => {
    state.model = await get(where, {}, signal);
    if (!state.model.versions.some((each) => each.version === state.version.version)) await select(shownFirst(state.model));
    else await show();
  };

  const [top, updateTop] = header(state, reload);
  const choose = chooser(choice, state, show, select);
  const list = tabs(TABS.map(([tab, label]) => [tab, label]), (tab) => {
    state.tab = tab;
    show();
  }, state.tab);
  list.setAttribute("aria-label", `Model ${name}`);
  replace(view, top, choice, list, panel);
}

/** The version that a page shows where none is named. */
function shownFirst(model) {
  return model.serving_version ?? model.latest_version;
}

/** What stands above all tabs: what can be done, and what is looked at. Returns its element, and what brings it up to date. */
function header(state, reload) {
  const { name, where } = state;
  const promote = button("", async () => {
    const shown = state.version.version;
    if (!(await confirmServing(name, state.version, state.model.serving_version))) return;
    await put(`${where}/aliases/serving`, { version: shown });
    notice(`Version ${shown} of ${name} answers from now on.`);
    await reload();
  }, { kind: "primary" });
  const actions = h("div", { class: "actions" }), about = h("div", {});
  const follow = link("Follow live", `#/live/${encodeURIComponent(name)}`);
  const train = link("Train a new version", `#/train?model=${encodeURIComponent(name)}`);
  const update = () => {
    const { version, model: { serving_version: serving, aliases } } = state;
    const shown = version.version;
    const names = Object.entries(aliases).map(([alias, number]) => `${alias} → ${number}`);
    promote.textContent = `Serve version ${shown}`;
    const { word, kind, why } = mayAnswer(version);
    promote.title = `${why}.`;
    refresh(actions, shown === serving ? badge("serving") : [badge(word, kind), promote], follow, train);
    const other = serving === null ? "no version answers" : `version ${serving} answers`;
    const answers = shown === serving ? `Version ${shown} answers` : `You look at version ${shown}, ${other}`;
    refresh(about, h("p", { class: "muted" }, [answers, version.estimator, `made ${when(version.created_at)}`, ...names].join(" · ")), shown === serving || promoted(version)?.matches(".banner") ? promoted(version) : h("p", { class: "hint" }, `${why}.`), warned(version.warnings));
  };
  return [h("div", {}, heading(name, actions), about), update];
}

/** The address names what is looked at, so that it can be shared; nothing is loaded for it. */
function remember({ name, version, dataset, part, tab }) {
  const said = new URLSearchParams({ version: version.version, ...(dataset ? { dataset } : {}), ...(part === "all" ? {} : { part }), tab });
  history.replaceState(null, "", `#/models/${encodeURIComponent(name)}?${said}`);
}
