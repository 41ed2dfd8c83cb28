// Follows a model's live events, and again after the connection was lost, until the page is left.

import { ApiError, events, path } from "../../api.js";

const SILENT_MS = 6000; // a status comes every second
const LONGEST_S = 10;
const FINAL = [400, 401, 403, 404, 422];

/**
 * Tell hear(event, data) of every event, and tell({state, why}) whenever that changes: "following" or "lost".
 * Throws ApiError where asking again would not help.
 */
export async function follow(name, signal, hear, tell) {
  let wait = 1;
  while (!signal.aborted) {
    const why = await attempt(name, signal, hear, () => {
      wait = 1;
      tell({ state: "following" });
    });
    if (signal.aborted) return;
    tell({ state: "lost", why });
    await pause(wait, signal);
    wait = Math.min(2 * wait, LONGEST_S);
  }
}

/** Follow until it ends; returns why. */
async function attempt(name, signal, hear, begun) {
  const one = new AbortController();
  const stop = () => one.abort();
  let heard = null;
  const watch = setInterval(() => heard !== null && Date.now() - heard > SILENT_MS && stop(), 1000);
  signal.addEventListener("abort", stop);
  try {
    for await (const { event, data } of events(path`/v1/models/${name}/live`, one.signal)) {
      if (heard === null) begun();
      heard = Date.now();
      hear(event, data);
    }
    return "the service ended it";
  } catch (error) {
    if (signal.aborted) return "";
    if (error instanceof ApiError && FINAL.includes(error.status)) throw error;
    if (error instanceof ApiError) return error.message;
    if (one.signal.aborted) return `nothing was heard for ${SILENT_MS / 1000} s`;
    if (error instanceof TypeError && heard !== null) return "it broke off";
    throw error;
  } finally {
    clearInterval(watch);
    signal.removeEventListener("abort", stop);
  }
}

function pause(seconds, signal) {
  return new Promise((resolve) => {
    const timer = setTimeout(resolve, 1000 * seconds);
    signal.addEventListener("abort", () => (clearTimeout(timer), resolve()), { once: true });
  });
}
