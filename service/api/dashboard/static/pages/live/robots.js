// List of the streaming robots with their models and states.

import { get, pages, path } from "../../api.js";
import { h, refresh, replace } from "../../dom.js";
import { ago, kilograms, percent, scientific, sentence } from "../../format.js";
import { badge, card, empty, heading, link, repeat, table } from "../../ui.js";

const PERIOD_S = 3;
const MAX_MODELS = 100;
const MAX_DETAILED = 20; // models to read streams of, the most recent first

/** Show the list and update it while the page is visible; throw an error of the first update. */
export async function robots(view, signal) {
  const place = h("div", {}), stale = h("div", { role: "status" });
  let isShown = false;
  const update = async () => {
    const models = await pages("/v1/overview", MAX_MODELS, {}, signal);
    const found = await streams(models, signal);
    if (signal.aborted) return;
    refresh(stale);
    refresh(place, shown(models, found));
    if (!isShown) replace(view, heading("Live"), stale, place);
    isShown = true;
  };
  await update();
  repeat(PERIOD_S, () => update().catch((error) => {
    if (!signal.aborted) refresh(stale, h("p", { class: "banner" }, `Out of date. ${sentence(error.message)} Retrying.`));
  }), signal);
}

/** Return the address of a model's live page. */
export function address(name) {
  return `#/live/${encodeURIComponent(name)}`;
}

/** Read the streams of the models, {model, stream, heard}, the most recent first. heard: time of the last row, ISO 8601; null if unknown. */
async function streams(models, signal) {
  const heard = models.filter((each) => each.idle_s !== null).sort((one, other) => one.idle_s - other.idle_s);
  const found = await Promise.all(heard.slice(0, MAX_DETAILED).map(async (model) => {
    const where = path`/v1/models/${model.name}`;
    try {
      const { status } = await get(`${where}/learning`, {}, signal);
      return await Promise.all(status.streams.map(async ({ stream_id: stream }) => {
        const { items } = await get(`${where}/observations`, { stream_id: stream, limit: 1 }, signal);
        return { model, stream, heard: items[0]?.received_at ?? null };
      }));
    } catch (error) {
      if (error.name !== "ApiError" || error.status !== 404) throw error;
      return []; // the model was deleted meanwhile
    }
  }));
  const known = [...found.flat(), ...heard.slice(MAX_DETAILED).map((model) => ({ model, stream: null, heard: null }))];
  return known.sort((one, other) => Date.parse(other.heard ?? 0) - Date.parse(one.heard ?? 0));
}

const LIVE_S = 10;

function shown(models, found) {
  if (!models.length) {
    const hint = "No models yet. Upload a recording of your robot, then train a model on it.";
    return empty(hint, link("Upload a recording", "#/data", "primary"));
  }
  const silent = models.filter((each) => each.idle_s === null);
  return [
    found.length ? card("Robots", list(found)) : empty(["No streams yet. Try a simulated robot: ", h("code", {}, `lipserve stream ${models[0].name} --simulate panda --learn`)]),
    silent.length ? card("Models without a stream", h("ul", { class: "names" }, silent.map(({ name }) => h("li", { "data-key": name }, link(name, address(name)))))) : null,
  ];
}

function list(found) {
  return table(
    [
      { label: "Robot", cell: ({ model, stream }) => link(stream ?? "several", address(model.name)) },
      { label: "State", cell: state },
      { label: "Model", cell: ({ model }) => link(model.name, address(model.name)) },
      { label: "Last row", cell: ({ heard }) => (heard === null ? "–" : ago(heard)) },
      { label: "Max nMSE", numeric: true, cell: ({ model }) => figure(model, "nmse", Math.max, scientific) },
      { label: "Min 95 % coverage", numeric: true, cell: ({ model }) => figure(model, "coverage", Math.min, percent) },
      { label: "Payload", cell: payloadOf },
      { label: "Last alarm", cell: ({ model: { alarm } }) => (alarm ? `${alarm.kind}, ${ago(alarm.at)}` : "none") },
    ],
    found,
    { caption: "Figures: worst joint of the model in the last hour", key: ({ model, stream }) => `${model.name}/${stream}` },
  );
}

function state({ model, stream, heard }) {
  const payload = model.payloads?.find((each) => each.stream_id === stream);
  const live = heard !== null && Date.now() - Date.parse(heard) < 1000 * LIVE_S;
  if (model.held) return badge("paused", "warn");
  if (model.failure) return badge("learning failed", "bad");
  if (!live) return badge("idle", "plain");
  if (payload?.state === "contact") return badge("contact", "warn");
  return badge("live", "good");
}

function payloadOf({ model, stream }) {
  const mass = model.payloads?.find((each) => each.stream_id === stream)?.mass;
  return mass ? kilograms(mass) : "–";
}

function figure({ recent }, name, worst, format) {
  const known = (recent?.[name] ?? []).filter((each) => each !== null);
  return known.length ? format(worst(...known)) : "–";
}
