// Overview: whether the service is well, what runs, what is there, and what to do next.

import { get } from "../api.js";
import { h, replace } from "../dom.js";
import { heading, link, loading } from "../ui.js";
import { attention, warnings } from "./overview/attention.js";
import { follow } from "./overview/follow.js";
import { health } from "./overview/health.js";
import { counts } from "./overview/counts.js";
import { jobBoard } from "./overview/jobs.js";
import { newestModels } from "./overview/models.js";
import { steps } from "./overview/steps.js";

const OFTEN_S = 2;
const SELDOM_S = 10;

export async function render(view, _params, { signal, title }) {
  title("Overview");
  const places = Object.fromEntries(["stale", "attention", "steps", "counts", "jobs", "models"].map((name) => [name, h("div", { class: "place" })]));
  const well = h("div");
  replace(
    view,
    heading("Overview", link("Upload a recording", "#/data", "button"), link("Train a model", "#/train", "primary")),
    well,
    places.stale,
    places.attention,
    places.steps,
    places.counts,
    places.jobs,
    places.models,
  );
  const seen = { data: null, models: null, jobs: null };
  replace(places.counts, loading());

  const tell = () => {
    if (!seen.data || !seen.models || !seen.jobs) return;
    counts(places.counts, seen);
    steps(places.steps, seen);
  };
  health(well, OFTEN_S, signal);
  follow(OFTEN_S, places.stale, signal, async (until) => {
    seen.jobs = await get("/v1/jobs", {}, until);
    jobBoard(places.jobs, seen.jobs.items);
    tell();
  });
  follow(SELDOM_S, places.stale, signal, async (until) => {
    [seen.data, seen.models] = await Promise.all([get("/v1/datasets", {}, until), get("/v1/models", {}, until)]);
    newestModels(places.models, seen.models.items);
    tell();
    attention(places.attention, await warnings(seen.models.items, until));
  });
}
