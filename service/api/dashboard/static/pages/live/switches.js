// Switches of learning where it is watched: pause it, what follows a change, how fast it forgets, and going back.

import { get, path, post, put } from "../../api.js";
import { h, refresh } from "../../dom.js";
import { count, counted, seconds, when } from "../../format.js";
import { button, confirm, field, notice, offer, select } from "../../ui.js";

const ON_CHANGE = [
  ["hold", "wait for my decision"],
  ["adapt", "adapt to it"],
  ["learn", "learn on as before"],
];
const MEMORIES_S = [60, 600, 3600, 86400, 604800];

/**
 * The switches of a model. Returns {element, look(status)}: reads again what is set where a live status says that
 * something else is now.
 */
export function switches(name, signal) {
  const where = path`/v1/models/${name}`;
  let now = null, known = "";
  const set = async (changed, said) => {
    take(await put(`${where}/learning`, { ...now.options, ...changed }, signal));
    notice(said);
  };
  const pause = button("", () => set({ enabled: !now.options.enabled }, now.options.enabled ? "Learning is paused. Rows are still compared with the model." : "Learning has resumed."));
  const change = select(ON_CHANGE, "hold", (value) => attempt(() => set({ on_change: value }, "It is set.")));
  const memory = select([], "", (value) => attempt(() => set({ forgetting_s: value ? Number(value) : null }, value ? `What was learnt ${seconds(Number(value))} ago counts a third of what is learnt now.` : "Nothing is forgotten.")));
  const target = select([], "");
  const back = button("Roll back", async () => {
    const revision = Number(target.value);
    const what = revision === 0 ? "All that it has learnt while it served is forgotten; it answers as it was trained." : `What was learnt after revision ${count(revision)} is forgotten.`;
    if (!(await confirm(`${what} The log keeps the rows, but they will not teach again by themselves.`, "Roll back"))) return;
    const done = await post(`${where}/rollback`, { revision }, signal);
    notice(`Back at revision ${count(revision)}: ${counted(done.undone, "batch", "batches")} undone.`);
    take(await get(`${where}/learning`, {}, signal));
  }, { kind: "danger" });
  const going = h("div", { class: "going" }, field("Go back to", target), back);
  const element = h("div", { class: "switches" });

  function take(found) {
    now = found;
    const { options, status } = found;
    pause.textContent = options.enabled ? "Pause learning" : "Resume learning";
    offer(change, ON_CHANGE, options.on_change);
    const memories = [...new Set([...MEMORIES_S, options.forgetting_s].filter((each) => each !== null))].sort((a, b) => a - b);
    offer(memory, [["", "nothing"], ...memories.map((each) => [String(each), `what is older than ${seconds(each)}`])], String(options.forgetting_s ?? ""));
    const reached = (revision) => status.reachable.some(([first, last]) => first <= revision && revision <= last);
    const targets = [...status.snapshots.filter((each) => each.revision > 0 && each.revision < status.revision).map((each) => [String(each.revision), `revision ${count(each.revision)}, ${when(each.created_at)}`]), ["0", "as it was trained"]].filter(([revision]) => reached(Number(revision)));
    offer(target, targets, target.value || targets[0]?.[0]);
    refresh(element, pause, field("When the robot changes", change), field("Forget", memory), status.revision > 0 && targets.length ? going : null);
  }
  const attempt = (work) => work().catch((error) => error.name === "AbortError" || notice(error.message, "bad"));
  return {
    element,
    look(status) {
      const seen = [status.learns, status.on_change, status.revision > 0, status.version, status.held?.at].join();
      if (seen === known) return;
      known = seen;
      attempt(async () => take(await get(`${where}/learning`, {}, signal)));
    },
  };
}
