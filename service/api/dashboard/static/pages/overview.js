// Overview: models, training jobs, health of the service, first steps.

import { get } from "../api.js";
import { h, replace } from "../dom.js";
import { heading, link, loading } from "../ui.js";
import { follow } from "./overview/follow.js";
import { health } from "./overview/health.js";
import { jobBoard } from "./overview/jobs.js";
import { robots } from "./overview/robots.js";
import { steps } from "./overview/steps.js";

const PERIOD_S = 2;
const MAX_MODELS = 24;

/** The page `#/`. */
export async function render(view, _params, { signal, title }) {
  title("Overview");
  const places = Object.fromEntries(["stale", "steps", "robots", "jobs", "health"].map((name) => [name, h("div", { class: "place" })]));
  replace(
    view,
    heading("Overview", link("Upload a recording", "#/data", "button"), link("Train a model", "#/train", "primary")),
    places.health,
    places.stale,
    places.steps,
    places.robots,
    places.jobs,
  );
  const waiting = loading();
  places.robots.append(waiting);
  const show = robots(places.robots);
  const found = { data: null, models: null, jobs: null };
  const showSteps = () => {
    if (found.data !== null && found.models && found.jobs) steps(places.steps, found);
  };
  health(places.health, PERIOD_S, signal);
  follow(PERIOD_S, places.stale, signal, async (until) => {
    found.jobs = (await get("/v1/jobs", {}, until)).items;
    jobBoard(places.jobs, found.jobs);
    showSteps();
  });
  follow(PERIOD_S, places.stale, signal, async (until) => {
    const page = await get("/v1/overview", { limit: MAX_MODELS }, until);
    found.models = page.items;
    if (!found.data) found.data = (await get("/v1/datasets", { limit: 1 }, until)).items.length > 0;
    waiting.remove();
    show(page);
    showSteps();
  });
}
