// One data set: findings, and tabs with its signals, its report, and another reading of its file.

import { del, get, path } from "../api.js";
import { Await, Button, Heading, Link, page, Tabs, useRead } from "../components.js";
import { html, useEffect, useState } from "../preact.js";
import { confirm, notice } from "../dialogs.js";
import { Corrections, ReadAgain, useReading } from "./data/again.js";
import { ExcitationTab, FrictionTab, PreparationTab, TimingTab } from "./data/figures.js";
import { Warnings } from "./data/findings.js";
import { Recommendations, Summary } from "./data/report.js";
import { rowsOf } from "./data/rows.js";
import { Signals } from "./data/signals.js";
import { VerdictNote } from "../verdicts.js";

const TABS = [
  ["signals", "Signals"],
  ["timing", "Timing"],
  ["excitation", "Excitation"],
  ["friction", "Friction"],
  ["preparation", "Preparation"],
  ["again", "Read again"],
];
const FIGURES = { timing: TimingTab, excitation: ExcitationTab, friction: FrictionTab, preparation: PreparationTab };

/** The page `#/data/{id}`; `?tab=timing` selects a tab, `?hold_out=300-450` the rows to hold out. */
function DataSet({ id, query, title }) {
  const reading = useRead((signal) => get(path`/v1/datasets/${id}`, {}, signal), [id]);
  useEffect(() => title(reading.value?.name ?? ""), [reading.value]);
  return html`<${Await} reading=${reading}>${(dataset) => html`<${View} dataset=${dataset} query=${query} />`}<//>`;
}

function View({ dataset, query }) {
  const { id, name, report } = dataset;
  const kept = Boolean(report.upload_options); // the uploaded file
  const tabs = TABS.filter(([tab]) => tab !== "again" || kept);
  const [tab, setTab] = useState(tabs.some(([each]) => each === query.get("tab")) ? query.get("tab") : "signals");
  const [rows, setRows] = useState(rowsOf(query.get("hold_out")));
  const again = useReading(dataset);
  const held = rows ? { hold_out: rows.join("-") } : {};
  useEffect(() => {
    const shown = new URLSearchParams({ ...(tab === "signals" ? {} : { tab }), ...held }).toString();
    history.replaceState(null, "", `#/data/${encodeURIComponent(id)}${shown && `?${shown}`}`);
  }, [tab, rows]);
  const remove = async () => {
    const question = `Delete “${name}” (${id})? Its samples are deleted. Models trained on it remain, but can no longer be evaluated on it.`;
    if (!(await confirm(question, "Delete"))) return;
    await del(path`/v1/datasets/${id}`);
    notice(`${name} deleted.`);
    location.hash = "#/data";
  };
  const Figures = FIGURES[tab];
  return html`
    <${Heading} text=${name}><${Link} kind="primary" to=${`#/train?${new URLSearchParams({ datasets: id, ...held })}`}>Train on this recording<//><${Button} kind="danger" onclick=${remove}>Delete<//><//>
    <${Summary} dataset=${dataset} />
    <${VerdictNote} verdict=${dataset.learnability} about="A model of this recording can at best be" />
    <${Warnings} texts=${report.warnings} />
    ${kept && html`<${Corrections} dataset=${dataset} again=${again} />`}
    <${Recommendations} dataset=${dataset} />
    <${Tabs} label=${`Report of ${name}`} options=${tabs} chosen=${tab} onchoose=${setTab}>
      ${tab === "signals" && html`<${Signals} dataset=${dataset} rows=${rows} choose=${setRows} />`}
      ${tab === "again" && html`<${ReadAgain} dataset=${dataset} again=${again} />`}
      ${Figures && html`<${Figures} report=${report} joints=${dataset.joint_names} />`}
    <//>`;
}

export const render = page(DataSet);
