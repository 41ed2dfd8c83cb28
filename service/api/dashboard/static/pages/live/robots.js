// Robots that stream, with the model that answers each and its state; the live page's index.

import { get, pages, path } from "../../api.js";
import { h, refresh, replace } from "../../dom.js";
import { ago, kilograms, percent, scientific } from "../../format.js";
import { badge, card, empty, every, heading, link, table } from "../../ui.js";

const EVERY_S = 3;
const MOST_MODELS = 100;
const MOST_ASKED = 20; // models whose streams are looked at, those first that were heard last

/** Show the index, and look again while it is seen; throws where nothing can be had at first. */
export async function robots(view, signal) {
  const place = h("div", {}), stale = h("div", { role: "status" });
  let begun = false;
  const look = async () => {
    const models = await pages("/v1/overview", MOST_MODELS, {}, signal);
    const found = await streams(models, signal);
    if (signal.aborted) return;
    refresh(stale);
    refresh(place, shown(models, found));
    if (!begun) replace(view, heading("Live"), stale, place);
    begun = true;
  };
  await look();
  every(EVERY_S, () => look().catch((error) => {
    if (!signal.aborted) refresh(stale, h("p", { class: "banner" }, `What is shown here is out of date: ${error.message}. Trying again.`));
  }), signal);
}

/** Where the page of a model is. */
export function address(name) {
  return `#/live/${encodeURIComponent(name)}`;
}

/** Streams of the models, {model, stream, heard}, those first that were heard last. heard: when, ISO 8601; null: not known. */
async function streams(models, signal) {
  const heard = models.filter((each) => each.idle_s !== null).sort((one, other) => one.idle_s - other.idle_s);
  const found = await Promise.all(heard.slice(0, MOST_ASKED).map(async (model) => {
    const where = path`/v1/models/${model.name}`;
    try {
      const { status } = await get(`${where}/learning`, {}, signal);
      return await Promise.all(status.streams.map(async ({ stream_id: stream }) => {
        const { items } = await get(`${where}/observations`, { stream_id: stream, limit: 1 }, signal);
        return { model, stream, heard: items[0]?.received_at ?? null };
      }));
    } catch (error) {
      if (error.name !== "ApiError" || error.status !== 404) throw error;
      return []; // it was deleted meanwhile
    }
  }));
  const known = [...found.flat(), ...heard.slice(MOST_ASKED).map((model) => ({ model, stream: null, heard: null }))];
  return known.sort((one, other) => Date.parse(other.heard ?? 0) - Date.parse(one.heard ?? 0));
}

const LIVE_S = 10;

function shown(models, found) {
  if (!models.length) {
    const said = "There is no model to follow yet. Upload a recording of your robot, then train a model on it.";
    return empty(said, link("Upload a recording", "#/data", "primary"));
  }
  const silent = models.filter((each) => each.idle_s === null);
  return [
    found.length ? card("Robots", list(found)) : empty(["No robot streams yet. Try a simulated one: ", h("code", {}, `lipserve stream ${models[0].name} --simulate panda --learn`)]),
    silent.length ? card("Models that no robot has streamed to", h("ul", { class: "names" }, silent.map(({ name }) => h("li", { "data-key": name }, link(name, address(name)))))) : null,
  ];
}

function list(found) {
  return table(
    [
      { label: "Robot", cell: ({ model, stream }) => link(stream ?? "several", address(model.name)) },
      { label: "State", cell: state },
      { label: "Model", cell: ({ model }) => link(model.name, address(model.name)) },
      { label: "Last row", cell: ({ heard }) => (heard === null ? "–" : ago(heard)) },
      { label: "Largest nMSE", numeric: true, cell: ({ model }) => figure(model, "nmse", Math.max, scientific) },
      { label: "Least in 95 %", numeric: true, cell: ({ model }) => figure(model, "coverage", Math.min, percent) },
      { label: "Carries", cell: carries },
      { label: "Newest alarm", cell: ({ model: { alarm } }) => (alarm ? `${alarm.kind}, ${ago(alarm.at)}` : "none") },
    ],
    found,
    { caption: "Figures are of the model’s last hour, its worst joint", key: ({ model, stream }) => `${model.name}/${stream}` },
  );
}

function state({ model, stream, heard }) {
  const payload = model.payloads?.find((each) => each.stream_id === stream);
  const live = heard !== null && Date.now() - Date.parse(heard) < 1000 * LIVE_S;
  if (model.held) return badge("waits for you", "warn");
  if (model.failure) return badge("cannot learn", "bad");
  if (!live) return badge("quiet", "plain");
  if (payload?.state === "contact") return badge("contact", "warn");
  return badge("live", "good");
}

function carries({ model, stream }) {
  const mass = model.payloads?.find((each) => each.stream_id === stream)?.mass;
  return mass ? kilograms(mass) : "–";
}

function figure({ recent }, name, worst, format) {
  const known = (recent?.[name] ?? []).filter((each) => each !== null);
  return known.length ? format(worst(...known)) : "–";
}
