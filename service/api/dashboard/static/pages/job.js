// One training job: followed live, cancelled, repeated, and what came of it.

import { get, path, post } from "../api.js";
import { h, refresh, replace } from "../dom.js";
import { count, percent, seconds, when } from "../format.js";
import { badge, button, card, confirm, errorBox, every, facts, heading, link, notice, progress } from "../ui.js";
import { outcome } from "./job/outcome.js";
import { follow } from "./job/following.js";
import { Objective } from "./job/objective.js";
import { ACTIVE, heldOut, left, stage } from "./job/words.js";

const QUIET_S = 5;
const MOST_NAMES = 10;

/** The page `#/jobs/{id}`. */
export async function render(view, { id }, { signal, title }) {
  let job = await get(path`/v1/jobs/${id}`, {}, signal);
  title(`Training ${job.model}`);
  const actions = h("div", { class: "actions" });
  const state = h("p", { role: "status" });
  const bar = progress(0, "Progress of the training");
  const figures = h("div", {});
  const quiet = h("p", { class: "banner", role: "status", hidden: true });
  const result = h("div", {});
  const place = h("div", {});
  const about = h("p", { class: "hint" });
  const curve = h("div", {}, card("Objective", place, about));
  const past = h("ol", {});
  const wanted = h("div", {});
  const names = new Map(job.datasets.map((each) => [each, each]));
  const objective = new Objective(place, signal);
  let heard = Date.now();
  let trouble = "";

  const cancel = button("Cancel training", async () => {
    if (!(await confirm(`Stop the training of ${job.model}? Nothing of it is kept.`, "Stop training"))) return;
    take(await post(path`/v1/jobs/${id}/cancel`, undefined, signal));
  }, { kind: "danger" });
  const retry = button("Try it again", async () => {
    const again = await post(path`/v1/jobs/${id}/retry`, undefined, signal);
    notice("The same job is queued again.");
    location.hash = `#/jobs/${again.id}`;
  }, { kind: "primary" });

  const watched = ACTIVE.has(job.state);
  let shown = "";
  let first = true;
  const take = (now) => {
    job = now;
    heard = Date.now();
    trouble = "";
    const active = ACTIVE.has(job.state);
    const key = JSON.stringify([job.state, job.history, job.version]);
    if (key !== shown) {
      shown = key;
      refresh(actions, ...offered(job, cancel, retry));
      refresh(state, badge(job.state), " ", job.history.at(-1)?.message ?? "");
      refresh(past, job.history.map((entry) => h("li", {}, h("span", { class: "muted" }, when(entry.at)), " ", badge(entry.state), ` ${entry.message}`)));
      refresh(wanted, asked(job, names));
      if (!active) outcome(result, job, signal);
    }
    bar.hidden = !active;
    bar.value = job.progress.fraction;
    refresh(figures, facts(live(job, active)));
    if (objective.take(job) || first) objective.draw(job).catch((error) => notice(error.message, "bad"));
    first = false;
    curve.hidden = !watched && Objective.points(id) < 2; // it is only known to who looked
    about.textContent = said(job, id);
    hush();
  };
  // figures that nobody has confirmed for a while are said to be old
  const hush = () => {
    const silent = job.state === "running" && Date.now() - heard > 1000 * QUIET_S;
    quiet.hidden = !(trouble || silent) || !ACTIVE.has(job.state);
    const text = `${trouble || "The job has sent nothing for a while."} What is shown is as of ${when(heard / 1000)}. Trying again.`;
    if (!quiet.hidden && quiet.textContent !== text) quiet.textContent = text;
  };

  replace(
    view,
    heading(`Training ${job.model}`, actions),
    quiet,
    result,
    card("State", state, bar, figures),
    curve,
    h("div", { class: "grid wide" }, card("Request", wanted), card("History", past)),
  );
  take(job);
  named(names, signal).then(() => refresh(wanted, asked(job, names)));
  if (!ACTIVE.has(job.state)) return;
  every(1, async () => hush(), signal);
  follow(id, { onJob: take, onTrouble: (text) => { trouble = text; hush(); }, signal }).catch((error) => {
    replace(result, errorBox(error)); // it is gone
  });
}

function offered(job, cancel, retry) {
  if (ACTIVE.has(job.state)) return [cancel];
  if (job.state === "succeeded") return [link(`Look at version ${job.version}`, `#/models/${job.model}?version=${job.version}`, "primary")];
  return [retry];
}

function live(job, active) {
  const at = job.progress;
  const pairs = [...(active ? [["Doing", stage(job)]] : []), ["Iteration", iterations(at)]];
  if (active) pairs.push(["Done", percent(at.fraction, 0)]);
  pairs.push([active ? "Time so far" : "Time taken", seconds(at.elapsed_s)]);
  if (active) pairs.push(["Time left", left(job) || "not known yet"]);
  pairs.push(["Objective", at.objective === null ? "–" : `${at.objective.toFixed(1)} nats`]);
  return pairs;
}

// where several fits follow one another, or geometry is searched first, there are more than one fit may have
function iterations({ iteration, max_iterations: most }) {
  if (!most) return "–";
  return iteration > most ? count(iteration) : `${count(iteration)} of at most ${count(most)}`;
}

function said(job, id) {
  const many = Objective.points(id);
  const meaning = "The lower, the better the model explains the samples it is fitted to. It does not tell how well it predicts other motion.";
  if (!many) return `${meaning} The curve begins with the first iteration.`;
  const first = Objective.first(id);
  const missing = first > 1 ? ` It begins at iteration ${first}, when this page was opened.` : "";
  const whole = job.progress.iteration > many ? " Points come about twice a second, so some iterations have none." : "";
  return `${meaning}${missing}${whole}`;
}

/** Put the names of the data sets in; of one that is deleted the id stays. */
async function named(names, signal) {
  await Promise.all(
    [...names.keys()].slice(0, MOST_NAMES).map(async (id) => {
      const found = await get(path`/v1/datasets/${id}`, {}, signal).catch(() => null);
      if (found) names.set(id, found.name);
    }),
  );
}

const TRIGGERS = { asked: "on request", novelty: "as too much motion was novel", linearisation: "as learning moved its arm too far" };

function asked(job, names) {
  const sets = job.datasets.map((id, index) => [index ? ", " : "", link(names.get(id), `#/data/${id}`)]);
  return facts([
    ["Model", job.version === null ? job.model : link(job.model, `#/models/${job.model}`)], // before that it may not be there
    ["Estimator", job.estimator],
    ["Robot", job.robot ?? "none needed"],
    ["Data sets", sets.length ? sets : "–"],
    ["Held out", heldOut(job.holdout)],
    ...(job.refresh ? [["Refresh of", `version ${job.refresh.version}, ${TRIGGERS[job.refresh.trigger]}`]] : []),
    ...(job.retry_of ? [["Repeats", link("an earlier job", `#/jobs/${job.retry_of}`)]] : []),
    ["Queued", when(job.created_at)],
    ["Started", job.started_at ? when(job.started_at) : "not yet"],
    ["Attempts", count(job.attempts)],
    ["Id", h("code", {}, job.id)],
    ...(job.request_id ? [["Request id", h("code", {}, job.request_id)]] : []),
  ]);
}
