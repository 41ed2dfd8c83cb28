// One training job: progress, cancel, retry, result.

import { get, path, post } from "../api.js";
import { h, refresh, replace } from "../dom.js";
import { count, percent, seconds, sentence, when } from "../format.js";
import { badge, button, card, confirm, errorBox, facts, heading, link, notice, progress, repeat } from "../ui.js";
import { outcome } from "./job/outcome.js";
import { follow } from "./job/following.js";
import { Objective } from "./job/objective.js";
import { ACTIVE, heldOut, remaining, stage } from "./job/words.js";

const STALE_AFTER_S = 5;
const MAX_NAMES = 10;

/** The page `#/jobs/{id}`. */
export async function render(view, { id }, { signal, title }) {
  let job = await get(path`/v1/jobs/${id}`, {}, signal);
  title(`Training ${job.model}`);
  const actions = h("div", { class: "actions" });
  const state = h("p", { role: "status" });
  const bar = progress(0, "Training progress");
  const figures = h("div", {});
  const staleBanner = h("p", { class: "banner", role: "status", hidden: true });
  const result = h("div", {});
  const place = h("div", {});
  const about = h("p", { class: "hint" });
  const curve = h("div", {}, card("Objective", place, about));
  const historyPlace = h("ol", {});
  const requestPlace = h("div", {});
  const names = new Map(job.datasets.map((each) => [each, each]));
  const objective = new Objective(place, signal);
  let updatedAt = Date.now();
  let trouble = "";

  const cancel = button("Cancel training", async () => {
    if (!(await confirm(`Cancel the training of ${job.model}? Its progress is lost.`, "Cancel training"))) return;
    update(await post(path`/v1/jobs/${id}/cancel`, undefined, signal));
  }, { kind: "danger" });
  const retry = button("Retry", async () => {
    const again = await post(path`/v1/jobs/${id}/retry`, undefined, signal);
    notice("A new job with the same request is queued.");
    location.hash = `#/jobs/${again.id}`;
  }, { kind: "primary" });

  const watched = ACTIVE.has(job.state);
  let shown = "";
  let first = true;
  const update = (now) => {
    job = now;
    updatedAt = Date.now();
    trouble = "";
    const active = ACTIVE.has(job.state);
    const key = JSON.stringify([job.state, job.history, job.version]);
    if (key !== shown) {
      shown = key;
      refresh(actions, ...jobActions(job, cancel, retry));
      refresh(state, badge(job.state), " ", job.history.at(-1)?.message ?? "");
      refresh(historyPlace, job.history.map((entry) => h("li", {}, h("span", { class: "muted" }, when(entry.at)), " ", badge(entry.state), ` ${entry.message}`)));
      refresh(requestPlace, request(job, names));
      if (!active) outcome(result, job, signal);
    }
    bar.hidden = !active;
    bar.value = job.progress.fraction;
    refresh(figures, facts(progressFacts(job, active)));
    if (objective.add(job) || first) objective.draw(job).catch((error) => notice(error.message, "bad"));
    first = false;
    curve.hidden = !watched && Objective.points(id) < 2; // only known if the page was open during the job
    about.textContent = objectiveHint(job, id);
    updateStaleBanner();
  };
  // mark figures as outdated if no update has arrived for a while
  const updateStaleBanner = () => {
    const silent = job.state === "running" && Date.now() - updatedAt > 1000 * STALE_AFTER_S;
    staleBanner.hidden = !(trouble || silent) || !ACTIVE.has(job.state);
    const text = `${trouble ? sentence(trouble) : "No updates have arrived for a while."} Last update: ${when(updatedAt / 1000)}. Retrying.`;
    if (!staleBanner.hidden && staleBanner.textContent !== text) staleBanner.textContent = text;
  };

  replace(
    view,
    heading(`Training ${job.model}`, actions),
    staleBanner,
    result,
    card("State", state, bar, figures),
    curve,
    h("div", { class: "grid wide" }, card("Request", requestPlace), card("History", historyPlace)),
  );
  update(job);
  loadNames(names, signal).then(() => refresh(requestPlace, request(job, names)));
  if (!ACTIVE.has(job.state)) return;
  repeat(1, async () => updateStaleBanner(), signal);
  follow(id, { onJob: update, onTrouble: (text) => { trouble = text; updateStaleBanner(); }, signal }).catch((error) => {
    replace(result, errorBox(error)); // the job was deleted
  });
}

function jobActions(job, cancel, retry) {
  if (ACTIVE.has(job.state)) return [cancel];
  if (job.state === "succeeded") return [link(`View version ${job.version}`, `#/models/${job.model}?version=${job.version}`, "primary")];
  return [retry];
}

function progressFacts(job, active) {
  const at = job.progress;
  const pairs = [...(active ? [["Stage", stage(job)]] : []), ["Iteration", iterations(at)]];
  if (active) pairs.push(["Progress", percent(at.fraction, 0)]);
  pairs.push([active ? "Elapsed" : "Duration", seconds(at.elapsed_s)]);
  if (active) pairs.push(["Remaining", remaining(job) || "unknown"]);
  pairs.push(["Objective", at.objective === null ? "–" : `${at.objective.toFixed(1)} nats`]);
  return pairs;
}

// the total exceeds the limit of one fit if several fits follow one another, or if the geometry is fitted first
function iterations({ iteration, max_iterations: most }) {
  if (!most) return "–";
  return iteration > most ? count(iteration) : `${count(iteration)} of max ${count(most)}`;
}

function objectiveHint(job, id) {
  const points = Objective.points(id);
  const meaning = "A lower objective means a better fit to the training samples. It does not measure how well the model predicts other motion.";
  if (!points) return `${meaning} The plot starts with the first iteration.`;
  const first = Objective.first(id);
  const missing = first > 1 ? ` The plot starts at iteration ${first}, when this page was opened.` : "";
  const whole = job.progress.iteration > points ? " There are about two points per second, so some iterations are missing." : "";
  return `${meaning}${missing}${whole}`;
}

/** Replace IDs of data sets by their names; that of a deleted one stays. */
async function loadNames(names, signal) {
  await Promise.all(
    [...names.keys()].slice(0, MAX_NAMES).map(async (id) => {
      const found = await get(path`/v1/datasets/${id}`, {}, signal).catch(() => null);
      if (found) names.set(id, found.name);
    }),
  );
}

const TRIGGERS = { asked: "on request", novelty: "triggered by novel motion", linearisation: "triggered by drift past the linearisation" };

function request(job, names) {
  const sets = job.datasets.map((id, index) => [index ? ", " : "", link(names.get(id), `#/data/${id}`)]);
  return facts([
    ["Model", job.version === null ? job.model : link(job.model, `#/models/${job.model}`)], // the model may not exist before
    ["Estimator", job.estimator],
    ["Robot", job.robot ?? "none"],
    ["Data sets", sets.length ? sets : "–"],
    ["Held out", heldOut(job.holdout)],
    ...(job.refresh ? [["Retraining of", `version ${job.refresh.version}, ${TRIGGERS[job.refresh.trigger]}`]] : []),
    ...(job.retry_of ? [["Retry of", link("an earlier job", `#/jobs/${job.retry_of}`)]] : []),
    ["Queued", when(job.created_at)],
    ["Started", job.started_at ? when(job.started_at) : "not yet"],
    ["Attempts", count(job.attempts)],
    ["ID", h("code", {}, job.id)],
    ...(job.request_id ? [["Request ID", h("code", {}, job.request_id)]] : []),
  ]);
}
