// First steps on a new service; hidden once they are done.

import { h, refresh } from "../../dom.js";
import { badge, card, link } from "../../ui.js";
import { changed } from "./follow.js";

const SHIPPED = "panda-sim";

/** Show the steps from a recording to a model, and which are done. */
export function steps(place, { data, models, jobs }) {
  const done = { data, trained: jobs.some((job) => job.state === "succeeded") || models.some((model) => model.name !== SHIPPED) };
  if (!changed(place, [done, models[0]?.name])) return;
  if (done.data && done.trained) return void place.replaceChildren();
  const shipped = models.find((model) => model.name === SHIPPED);
  refresh(
    place,
    card(
      "First steps",
      h(
        "ol",
        { class: "steps" },
        step(done.data, link("Upload a recording", "#/data"), " of your robot: positions, velocities and torques. No robot at hand? Simulate one:", command("lipserve simulate panda panda.csv")),
        step(done.trained, link("Train a model", "#/train"), " on it: the defaults suit most recordings."),
        step(false, "Evaluate it on motion that it was not trained on, then stream to it."),
      ),
      shipped
        ? h("p", { class: "hint" }, "Or explore first: ", link("panda-sim", "#/models/panda-sim"), " is a simulated Panda that comes with LIPServe.")
        : null,
    ),
  );
}

function step(done, ...what) {
  return h("li", {}, what, " ", done ? badge("done", "good") : null);
}

function command(text) {
  return h("pre", {}, h("code", {}, text));
}
