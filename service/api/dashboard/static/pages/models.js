// All models: their serving version and its quality.

import { pages } from "../api.js";
import { h, replace } from "../dom.js";
import { ago, count, when } from "../format.js";
import { listing } from "../tables.js";
import { card, empty, heading, link } from "../ui.js";
import { QUALITY_HINT, qualityColumns } from "./quality.js";

const MAX_MODELS = 500;

/** The page `#/models`. */
export async function render(view, _params, { signal, title }) {
  title("Models");
  const models = await pages("/v1/models", MAX_MODELS, {}, signal);
  const train = link("Train a model", "#/train", "primary");
  if (!models.length) {
    const hint = "No models yet. Upload a recording of your robot, then train a model on it. This takes minutes.";
    replace(view, heading("Models"), empty(hint, link("Upload a recording", "#/data", "primary"), link("Train a model", "#/train")));
    return;
  }
  const serving = (model) => model.versions.find((each) => each.version === model.serving_version);
  const columns = [
    { label: "Model", value: (model) => model.name, cell: (model) => link(model.name, address(model.name)) },
    ...qualityColumns((model) => serving(model)?.verdict ?? null),
    { label: "Serving version", value: (model) => model.serving_version, cell: (model) => link(model.serving_version === null ? "none" : `version ${model.serving_version}`, `${address(model.name)}?tab=versions`) },
    { label: "Estimator", value: (model) => serving(model)?.estimator, cell: (model) => serving(model)?.estimator ?? "–" },
    { label: "Created", value: (model) => serving(model)?.created_at, first: "descending", cell: (model) => (serving(model) ? time(serving(model).created_at) : "–") },
    { label: "Versions", numeric: true, value: (model) => model.versions.length, first: "descending", cell: (model) => count(model.versions.length) },
    { label: "Aliases", cell: (model) => aliases(model.aliases) },
    { label: "Live", cell: (model) => h("a", { href: `#/live/${encodeURIComponent(model.name)}`, "aria-label": `Follow ${model.name} live` }, "follow") },
  ];
  const list = listing(columns, {
    caption: "Models",
    what: ["model", "models"],
    key: (model) => model.name,
    words: (model) => [model.name, serving(model)?.estimator, aliases(model.aliases)].join(" "),
  });
  list.show(models);
  replace(
    view,
    heading("Models", train),
    card("All models", list.element, h("p", { class: "hint" }, QUALITY_HINT), models.length === MAX_MODELS ? h("p", { class: "hint" }, `Showing the newest ${MAX_MODELS} models.`) : null),
  );
}

function time(at) {
  return h("time", { datetime: at, title: when(at) }, ago(at));
}

function address(name) {
  return `#/models/${encodeURIComponent(name)}`;
}

function aliases(named) {
  const found = Object.entries(named);
  return found.length ? found.map(([alias, version]) => `${alias} → ${version}`).join(", ") : "–";
}
