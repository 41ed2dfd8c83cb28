// Controls of online learning: pause, behaviour after a change, forgetting, rollback.

import { get, path, post, put } from "../../api.js";
import { h, refresh } from "../../dom.js";
import { count, counted, seconds, when } from "../../format.js";
import { button, confirm, field, notice, select, updateSelect } from "../../ui.js";

const ON_CHANGE = [
  ["hold", "pause learning"],
  ["adapt", "adapt"],
  ["learn", "continue learning"],
];
const MEMORIES_S = [60, 600, 3600, 86400, 604800];

/**
 * Create the controls of a model. Returns {element, update(status)}, which reads the settings again if a live status
 * shows that they changed.
 */
export function switches(name, signal) {
  const where = path`/v1/models/${name}`;
  let now = null, known = "";
  const set = async (changed, message) => {
    take(await put(`${where}/learning`, { ...now.options, ...changed }, signal));
    notice(message);
  };
  const pause = button("", () => set({ enabled: !now.options.enabled }, now.options.enabled ? "Learning paused. Rows are still compared with the predictions." : "Learning resumed."));
  const change = select(ON_CHANGE, "hold", (value) => attempt(() => set({ on_change: value }, "Saved.")));
  const memory = select([], "", (value) => attempt(() => set({ forgetting_s: value ? Number(value) : null }, value ? `Saved. Data that is ${seconds(Number(value))} old has a third of the weight of new data.` : "Saved. All data keeps its weight.")));
  const target = select([], "");
  const back = button("Roll back", async () => {
    const revision = Number(target.value);
    const what = revision === 0 ? "Everything learnt online is discarded; the model serves as trained." : `Everything learnt after revision ${count(revision)} is discarded.`;
    if (!(await confirm(`${what} The rows stay in the log, but are not learnt again automatically.`, "Roll back"))) return;
    const done = await post(`${where}/rollback`, { revision }, signal);
    notice(`Rolled back to revision ${count(revision)}: ${counted(done.undone, "batch", "batches")} undone.`);
    take(await get(`${where}/learning`, {}, signal));
  }, { kind: "danger" });
  const going = h("div", { class: "going" }, field("Roll back to", target), back);
  const element = h("div", { class: "switches" });

  function take(found) {
    now = found;
    const { options, status } = found;
    pause.textContent = options.enabled ? "Pause learning" : "Resume learning";
    updateSelect(change, ON_CHANGE, options.on_change);
    const memories = [...new Set([...MEMORIES_S, options.forgetting_s].filter((each) => each !== null))].sort((a, b) => a - b);
    updateSelect(memory, [["", "never"], ...memories.map((each) => [String(each), `after ${seconds(each)}`])], String(options.forgetting_s ?? ""));
    const reached = (revision) => status.reachable.some(([first, last]) => first <= revision && revision <= last);
    const targets = [...status.snapshots.filter((each) => each.revision > 0 && each.revision < status.revision).map((each) => [String(each.revision), `revision ${count(each.revision)}, ${when(each.created_at)}`]), ["0", "as trained"]].filter(([revision]) => reached(Number(revision)));
    updateSelect(target, targets, target.value || targets[0]?.[0]);
    refresh(element, pause, field("When the robot changes", change), field("Forget", memory), status.revision > 0 && targets.length ? going : null);
  }
  const attempt = (work) => work().catch((error) => error.name === "AbortError" || notice(error.message, "bad"));
  return {
    element,
    update(status) {
      const seen = [status.learns, status.on_change, status.revision > 0, status.version, status.held?.at].join();
      if (seen === known) return;
      known = seen;
      attempt(async () => take(await get(`${where}/learning`, {}, signal)));
    },
  };
}
