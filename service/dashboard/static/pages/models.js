// All models: which version answers, what it is, where to look at it.

import { pages } from "../api.js";
import { h, replace } from "../dom.js";
import { count, when } from "../format.js";
import { empty, heading, link, table } from "../ui.js";

const MOST = 500;

/** The page `#/models`. */
export async function render(view, _params, { signal, title }) {
  title("Models");
  const models = await pages("/v1/models", MOST, {}, signal);
  const train = link("Train a model", "#/train", "primary");
  if (!models.length) {
    const said = "There is no model yet. Upload a recording of your robot, then train a model on it: this takes minutes.";
    replace(view, heading("Models"), empty(said, link("Upload a recording", "#/data", "primary"), link("Train a model", "#/train")));
    return;
  }
  const serving = (model) => model.versions.find((each) => each.version === model.serving_version);
  const columns = [
    { label: "Model", cell: (model) => link(model.name, address(model.name)) },
    { label: "Answers", cell: (model) => `version ${model.serving_version}` },
    { label: "Estimator", cell: (model) => serving(model)?.estimator ?? "–" },
    { label: "Version made", cell: (model) => (serving(model) ? when(serving(model).created_at) : "–") },
    { label: "Versions", numeric: true, cell: (model) => count(model.versions.length) },
    { label: "Aliases", cell: (model) => aliases(model.aliases) },
    { label: "Live", cell: (model) => h("a", { href: `#/live/${encodeURIComponent(model.name)}`, "aria-label": `Follow ${model.name} live` }, "follow") },
  ];
  replace(
    view,
    heading("Models", train),
    table(columns, models, { caption: "Newest first" }),
    models.length === MOST ? h("p", { class: "hint" }, `The newest ${MOST} are shown.`) : null,
  );
}

function address(name) {
  return `#/models/${encodeURIComponent(name)}`;
}

function aliases(named) {
  const found = Object.entries(named);
  return found.length ? found.map(([alias, version]) => `${alias} → ${version}`).join(", ") : "–";
}
