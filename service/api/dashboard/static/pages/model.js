// One model: accuracy, parameters, versions, online learning, and a form for predictions.

import { get, pages, path } from "../api.js";
import { h, refresh, replace } from "../dom.js";
import { when } from "../format.js";
import { badge, button, errorBox, heading, link, loading, notice, tabs } from "../ui.js";
import { warningBanner } from "./data/prose.js";
import { accuracy } from "./model/accuracy.js";
import { arm } from "./model/arm.js";
import { predictForm } from "./model/predict.js";
import { chooser, firstChoice } from "./model/choice.js";
import { learning } from "./model/learning.js";
import { lineage } from "./model/lineage.js";
import { parts } from "./model/parts.js";
import { promotionNote } from "./model/promotion.js";
import { moveAlias, servingButton } from "./model/serving.js";
import { versions } from "./model/versions.js";
import { verdictNote } from "./verdict.js";

/** Tabs: name in the address, label, function that draws it, selects above the tabs that it uses. */
const TABS = [
  ["accuracy", "Accuracy", accuracy, { data: true, version: true }],
  ["parts", "Components and friction", parts, { data: true, version: true }],
  ["arm", "Arm", arm, { version: true }],
  ["versions", "Versions", versions, {}],
  ["lineage", "Lineage", lineage, { version: true }],
  ["ask", "Predict", predictForm, { version: true }],
  ["learning", "Learning", learning, {}],
];

/** The page `#/models/{name}`; `?version=2&dataset=ID&part=held_out&tab=versions` sets the selects and the tab. */
export async function render(view, { name, query }, { signal, title }) {
  title(name);
  const where = path`/v1/models/${name}`;
  const [model, datasets] = await Promise.all([get(where, {}, signal), pages("/v1/datasets", 200, {}, signal)]);
  const requested = Number(query.get("version"));
  const number = model.versions.some((each) => each.version === requested) ? requested : defaultVersion(model);
  const version = await get(`${where}/versions/${number}`, {}, signal);
  const state = { name, where, model, version, datasets, ...firstChoice(version, datasets, query) };
  state.tab = TABS.some(([tab]) => tab === query.get("tab")) ? query.get("tab") : "accuracy";

  const choice = h("div", { class: "grid" }), panel = h("div", { role: "tabpanel" });
  let shownTab = new AbortController();
  signal.addEventListener("abort", () => shownTab.abort());

  const show = async () => {
    shownTab.abort();
    shownTab = new AbortController();
    const mine = shownTab.signal;
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
  /** Show another version. */
  const select = async (chosen, tab = state.tab) => {
    replace(panel, loading());
    state.version = await get(`${where}/versions/${chosen}`, {}, signal);
    Object.assign(state, firstChoice(state.version, datasets, new URLSearchParams({ dataset: state.dataset ?? "" })));
    if (tab !== state.tab) list.querySelector(`[data-name="${tab}"]`).click();
    else await show();
  };
  /** Read the model again after a change. */
  const reload = async () => {
    state.model = await get(where, {}, signal);
    if (!state.model.versions.some((each) => each.version === state.version.version)) await select(defaultVersion(state.model));
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

/** Return the version that is shown by default. */
function defaultVersion(model) {
  return model.serving_version ?? model.latest_version;
}

/** Create the header with actions and the shown version. Returns its element and a function that updates it. */
function header(state, reload) {
  const { name } = state;
  const promote = button("", async () => {
    if (!(await moveAlias(state, "serving", state.version))) return;
    notice(`Version ${state.version.version} of ${name} is now serving.`);
    await reload();
  });
  const actions = h("div", { class: "actions" }), about = h("div", {});
  const follow = link("Follow live", `#/live/${encodeURIComponent(name)}`);
  const train = link("Train a new version", `#/train?model=${encodeURIComponent(name)}`);
  const update = () => {
    const { version, model: { serving_version: serving, aliases } } = state;
    const shown = version.version;
    const names = Object.entries(aliases).map(([alias, number]) => `${alias} → ${number}`);
    [promote.textContent, promote.className] = servingButton(version);
    refresh(actions, shown === serving ? badge("serving") : promote, follow, train);
    const other = serving === null ? "no version is serving" : `version ${serving} is serving`;
    const answers = shown === serving ? `Version ${shown} is serving` : `Viewing version ${shown} · ${other}`;
    refresh(about, h("p", { class: "muted" }, [answers, version.estimator, `created ${when(version.created_at)}`, ...names].join(" · ")), verdictNote(version.verdict), promotionNote(version), warningBanner(version.warnings));
  };
  return [h("div", {}, heading(name, actions), about), update];
}

/** Keep the selection in the address, so that it can be shared; do not navigate. */
function remember({ name, version, dataset, part, tab }) {
  const search = new URLSearchParams({ version: version.version, ...(dataset ? { dataset } : {}), ...(part === "all" ? {} : { part }), tab });
  history.replaceState(null, "", `#/models/${encodeURIComponent(name)}?${search}`);
}
