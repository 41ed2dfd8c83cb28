// The newest models, and ways to look at them.

import { h, refresh } from "../../dom.js";
import { when } from "../../format.js";
import { card, link, table } from "../../ui.js";
import { changed } from "./follow.js";

const SHOWN = 5;

/** A table of the newest models. */
export function newestModels(place, models) {
  const newest = models.slice(0, SHOWN);
  if (!changed(place, newest) || !newest.length) return;
  const columns = [
    { label: "Model", cell: (model) => link(model.name, `#/models/${encodeURIComponent(model.name)}`) },
    { label: "Answers", cell: (model) => `version ${model.serving_version}` },
    { label: "Estimator", cell: (model) => serving(model)?.estimator ?? "–" },
    { label: "Trained", cell: (model) => (serving(model) ? when(serving(model).created_at) : "–") },
    { label: "Live", cell: (model) => h("a", { href: `#/live/${encodeURIComponent(model.name)}`, "aria-label": `Follow ${model.name} live` }, "follow") },
  ];
  refresh(place, card("Newest models", table(columns, newest, { caption: "Newest first", key: (model) => model.name }), h("p", {}, link("All models", "#/models"))));
}

function serving(model) {
  return model.versions.find((version) => version.version === model.serving_version);
}
