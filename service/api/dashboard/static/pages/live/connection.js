// Follows the live events of a model; reconnects until the page is left.

import { ApiError, events, path } from "../../api.js";

const TIMEOUT_MS = 6000; // a status arrives every second
const MAX_WAIT_S = 10;
const PERMANENT = [400, 401, 403, 404, 422];

/**
 * Call onEvent(event, data) for every event, and onState({state, why}) if the state changes: "following" or "lost".
 * Throw an ApiError if a retry cannot succeed.
 */
export async function follow(name, signal, onEvent, onState) {
  let wait = 1;
  while (!signal.aborted) {
    const why = await attempt(name, signal, onEvent, () => {
      wait = 1;
      onState({ state: "following" });
    });
    if (signal.aborted) return;
    onState({ state: "lost", why });
    await pause(wait, signal);
    wait = Math.min(2 * wait, MAX_WAIT_S);
  }
}

/** Follow the events until the connection ends; return the reason. */
async function attempt(name, signal, onEvent, onStart) {
  const one = new AbortController();
  const stop = () => one.abort();
  let receivedAt = null;
  const watch = setInterval(() => receivedAt !== null && Date.now() - receivedAt > TIMEOUT_MS && stop(), 1000);
  signal.addEventListener("abort", stop);
  try {
    for await (const { event, data } of events(path`/v1/models/${name}/live`, one.signal)) {
      if (receivedAt === null) onStart();
      receivedAt = Date.now();
      onEvent(event, data);
    }
    return "closed by the service";
  } catch (error) {
    if (signal.aborted) return "";
    if (error instanceof ApiError && PERMANENT.includes(error.status)) throw error;
    if (error instanceof ApiError) return error.message;
    if (one.signal.aborted) return `no data for ${TIMEOUT_MS / 1000} s`;
    if (error instanceof TypeError && receivedAt !== null) return "interrupted";
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
