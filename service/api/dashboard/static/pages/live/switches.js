// Controls of online learning: pause, behaviour after a change, forgetting, rollback.

import { get, path, post, put } from "../../api.js";
import { Button, Choice } from "../../components.js";
import { count, counted, seconds, when } from "../../format.js";
import { html, useEffect, useState } from "../../preact.js";
import { confirm, notice } from "../../dialogs.js";

const ON_CHANGE = [["hold", "pause learning"], ["adapt", "adapt"], ["learn", "continue learning"]];
const MEMORIES_S = [60, 600, 3600, 86400, 604800];

/** The settings of a model, read again if a live status shows that they changed. */
export function Switches({ name, status, signal }) {
  const where = path`/v1/models/${name}`;
  const [now, setNow] = useState(null), [chosen, setChosen] = useState("");
  const read = async () => setNow(await get(`${where}/learning`, {}, signal));
  useEffect(() => void attempt(read), [status.learns, status.on_change, status.revision > 0, status.version, status.held?.at]);
  if (!now) return null;
  const { options } = now;
  const set = async (changed, message) => {
    setNow(await put(`${where}/learning`, { ...options, ...changed }, signal));
    notice(message);
  };
  const targets = targetsOf(now.status), target = targets.some(([value]) => value === chosen) ? chosen : targets[0]?.[0];
  const back = async () => {
    const revision = Number(target);
    const what = revision === 0 ? "Everything learnt online is discarded; the model serves as trained." : `Everything learnt after revision ${count(revision)} is discarded.`;
    if (!(await confirm(`${what} The rows stay in the log, but are not learnt again automatically.`, "Roll back"))) return;
    const done = await post(`${where}/rollback`, { revision }, signal);
    notice(`Rolled back to revision ${count(revision)}: ${counted(done.undone, "batch", "batches")} undone.`);
    await read();
  };
  const pause = () => set({ enabled: !options.enabled }, options.enabled ? "Learning paused. Rows are still compared with the predictions." : "Learning resumed.");
  const forget = (value) => attempt(() => set({ forgetting_s: value ? Number(value) : null }, value ? `Saved. Data that is ${seconds(Number(value))} old has a third of the weight of new data.` : "Saved. All data keeps its weight."));
  return html`<div class="switches">
    <${Button} onclick=${pause}>${options.enabled ? "Pause learning" : "Resume learning"}<//>
    <${Choice} label="When the robot changes" options=${ON_CHANGE} value=${options.on_change} onchange=${(value) => attempt(() => set({ on_change: value }, "Saved."))} />
    <${Choice} label="Forget" options=${memories(options)} value=${String(options.forgetting_s ?? "")} onchange=${forget} />
    ${now.status.revision > 0 && targets.length > 0 && html`<div class="going"><${Choice} label="Roll back to" options=${targets} value=${target} onchange=${setChosen} /><${Button} kind="danger" onclick=${back}>Roll back<//></div>`}
  </div>`;
}

function memories({ forgetting_s: own }) {
  const all = [...new Set([...MEMORIES_S, own].filter((each) => each !== null))].sort((a, b) => a - b);
  return [["", "never"], ...all.map((each) => [String(each), `after ${seconds(each)}`])];
}

/** Return the revisions that a rollback can return to, as options. */
function targetsOf({ snapshots, reachable, revision }) {
  const isReached = ([value]) => reachable.some(([first, last]) => first <= Number(value) && Number(value) <= last);
  const stored = snapshots.filter((each) => each.revision > 0 && each.revision < revision);
  return [...stored.map((each) => [String(each.revision), `revision ${count(each.revision)}, ${when(each.created_at)}`]), ["0", "as trained"]].filter(isReached);
}

function attempt(work) {
  return work().catch((error) => error.name === "AbortError" || notice(error.message, "bad"));
}
