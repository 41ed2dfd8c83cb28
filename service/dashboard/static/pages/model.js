// One model: how well it predicts, what it has learnt, its versions, and a form to ask it.

import { get, pages, path, put } from "../api.js";
import { h, replace } from "../dom.js";
import { when } from "../format.js";
import { badge, button, errorBox, facts, heading, link, loading, notice, tabs } from "../ui.js";
import { accuracy } from "./model/accuracy.js";
import { ask } from "./model/ask.js";
import { chooser, firstChoice } from "./model/choice.js";
import { learning } from "./model/learning.js";
import { lineage } from "./model/lineage.js";
import { parts } from "./model/parts.js";
import { confirmServing } from "./model/serving.js";
import { versions } from "./model/versions.js";

/** Each tab: its name in the address, its label, what shows it, and what of the choice above the tabs it goes by. */
const TABS = [
  ["accuracy", "Accuracy", accuracy, { data: true, version: true }],
  ["parts", "Parts and friction", parts, { data: true, version: true }],
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
  const number = model.versions.some((each) => each.version === asked) ? asked : model.serving_version;
  const version = await get(`${where}/versions/${number}`, {}, signal);
  const state = { name, where, model, version, datasets, ...firstChoice(version, datasets, query) };
  state.tab = TABS.some(([tab]) => tab === query.get("tab")) ? query.get("tab") : "accuracy";

  const top = h("div", {}), choice = h("div", {}), panel = h("div", { role: "tabpanel" });
  let left = new AbortController();
  signal.addEventListener("abort", () => left.abort());

  const show = async () => {
    left.abort();
    left = new AbortController();
    const mine = left.signal;
    const [tab, label, draw, needs] = TABS.find(([each]) => each === state.tab);
    remember(state);
    replace(top, header(state, reload));
    const focused = [...choice.querySelectorAll("select")].indexOf(document.activeElement);
    replace(choice, needs.version ? chooser(state, needs, show, select) : null);
    choice.querySelectorAll("select")[focused]?.focus(); // who uses the keyboard stays where they were
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
    if (!state.model.versions.some((each) => each.version === state.version.version)) await select(state.model.serving_version);
    else await show();
  };

  const list = tabs(TABS.map(([tab, label]) => [tab, label]), (tab) => {
    state.tab = tab;
    show();
  }, state.tab);
  list.setAttribute("aria-label", `Model ${name}`);
  replace(view, top, choice, list, panel);
}

function header({ name, where, model, version }, reload) {
  const { serving_version: serving, aliases } = model;
  const shown = version.version;
  const promote = button(`Let version ${shown} answer`, async () => {
    if (!(await confirmServing(name, shown, serving))) return;
    await put(`${where}/aliases/serving`, { version: shown });
    notice(`Version ${shown} of ${name} answers from now on.`);
    await reload();
  }, { kind: "primary" });
  const names = Object.entries(aliases).map(([alias, number]) => `${alias} → ${number}`);
  return [
    heading(
      name,
      shown === serving ? badge("serving") : null,
      shown === serving ? null : promote,
      link("Follow live", `#/live/${encodeURIComponent(name)}`),
      link("Train a new version", `#/train?model=${encodeURIComponent(name)}`),
    ),
    facts([
      ["Answers now", `version ${serving}`],
      ["You look at", `version ${shown}, ${version.estimator}, made ${when(version.created_at)}`],
      ...(names.length ? [["Aliases", names.join(", ")]] : []),
    ]),
  ];
}

/** The address names what is looked at, so that it can be shared; nothing is loaded for it. */
function remember({ name, version, dataset, part, tab }) {
  const said = new URLSearchParams({ version: version.version, ...(dataset ? { dataset } : {}), ...(part === "all" ? {} : { part }), tab });
  history.replaceState(null, "", `#/models/${encodeURIComponent(name)}?${said}`);
}
