// One data set: recommendations, and tabs with its signals and its report.

import { del, get, path } from "../api.js";
import { h, replace } from "../dom.js";
import { button, confirm, errorBox, heading, link, notice, tabs } from "../ui.js";
import { readingAgain } from "./data/again.js";
import { excitationTab, frictionTab, preparationTab, timingTab } from "./data/figures.js";
import { signals } from "./data/signals.js";
import { recommendations, summary } from "./data/report.js";
import { rowsOf } from "./data/hold_out.js";

/** Tabs: name in the address, label, contents. */
const TABS = [
  ["signals", "Signals", () => null],
  ["timing", "Timing", timingTab],
  ["excitation", "Excitation", excitationTab],
  ["friction", "Friction", frictionTab],
  ["preparation", "Preparation", preparationTab],
];

/** The page `#/data/{id}`; `?tab=timing` selects a tab, `?hold_out=300-450` the rows to hold out. */
export async function render(view, { id, query }, { signal, title }) {
  const dataset = await get(path`/v1/datasets/${id}`, {}, signal);
  title(dataset.name);
  const state = { tab: TABS.some(([tab]) => tab === query.get("tab")) ? query.get("tab") : TABS[0][0], rows: rowsOf(query.get("hold_out")) };
  const train = link("Train on this recording", "", "primary");
  const remember = () => {
    const held = state.rows ? { hold_out: state.rows.join("-") } : {};
    const seen = new URLSearchParams({ ...(state.tab === TABS[0][0] ? {} : { tab: state.tab }), ...held }).toString();
    history.replaceState(null, "", `#/data/${encodeURIComponent(id)}${seen && `?${seen}`}`);
    train.setAttribute("href", `#/train?${new URLSearchParams({ datasets: id, ...held })}`);
  };
  const choose = (rows) => {
    state.rows = rows;
    remember();
  };

  const panel = h("div", { role: "tabpanel" });
  let shownTab = new AbortController();
  signal.addEventListener("abort", () => shownTab.abort());
  const show = async (tab) => {
    shownTab.abort();
    shownTab = new AbortController();
    const mine = shownTab.signal;
    state.tab = tab;
    remember();
    const [, label, figures] = TABS.find(([each]) => each === tab);
    const plots = tab === "signals" ? h("section", { class: "card", "aria-label": "Signals" }) : null;
    panel.setAttribute("aria-label", label);
    replace(panel, h("div", { dataset: { tab } }, plots, figures(dataset)));
    try {
      if (plots) await signals(plots, dataset, { rows: state.rows, choose, signal: mine });
    } catch (error) {
      if (mine.aborted || error.name === "AbortError") return;
      if (error.name !== "ApiError") console.error(error);
      replace(plots, errorBox(error, () => show(tab)));
    }
  };
  const remove = button("Delete", async () => {
    const question = `Delete “${dataset.name}” (${dataset.id})? Its samples are deleted. Models trained on it remain, but can no longer be evaluated on it.`;
    if (!(await confirm(question, "Delete"))) return;
    await del(path`/v1/datasets/${id}`);
    notice(`${dataset.name} deleted.`);
    location.hash = "#/data";
  }, { kind: "danger" });
  const list = h("div", {});
  const [warnings, advice] = recommendations(dataset);
  const { corrections, form } = await readingAgain(dataset, signal);
  replace(view, heading(dataset.name, train, remove), summary(dataset), warnings, corrections, advice, list, panel, form);
  const bar = tabs(TABS.map(([tab, label]) => [tab, label]), show, state.tab);
  bar.setAttribute("aria-label", `Report of ${dataset.name}`);
  replace(list, bar);
}
