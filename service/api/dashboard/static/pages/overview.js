// Overview: every robot at a glance, what trains now, whether the service is well, and what to do first.

import { get } from "../api.js";
import { h, replace } from "../dom.js";
import { heading, link, loading } from "../ui.js";
import { follow } from "./overview/follow.js";
import { health } from "./overview/health.js";
import { jobBoard } from "./overview/jobs.js";
import { robots } from "./overview/robots.js";
import { steps } from "./overview/steps.js";

const OFTEN_S = 2;
const MODELS = 24;

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
  const seen = { data: null, models: null, jobs: null };
  const tell = () => {
    if (seen.data !== null && seen.models && seen.jobs) steps(places.steps, seen);
  };
  health(places.health, OFTEN_S, signal);
  follow(OFTEN_S, places.stale, signal, async (until) => {
    seen.jobs = (await get("/v1/jobs", {}, until)).items;
    jobBoard(places.jobs, seen.jobs);
    tell();
  });
  follow(OFTEN_S, places.stale, signal, async (until) => {
    const page = await get("/v1/overview", { limit: MODELS }, until);
    seen.models = page.items;
    if (!seen.data) seen.data = (await get("/v1/datasets", { limit: 1 }, until)).items.length > 0;
    waiting.remove();
    show(page);
    tell();
  });
}
