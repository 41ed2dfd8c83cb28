// Follows a job by its events; reconnects after a lost connection.

import { events, get, path } from "../../api.js";
import { ACTIVE } from "./words.js";

const RETRY_AFTER_S = 2;

/**
 * Report every change of a job until it ends or the signal aborts.
 * onJob(job): called for each change; onTrouble(text): called with the reason if there are no updates.
 */
export async function follow(id, { onJob, onTrouble, signal }) {
  let active = true;
  while (active && !signal.aborted) {
    try {
      for await (const { data } of events(path`/v1/jobs/${id}/events`, signal)) {
        active = ACTIVE.has(data.state);
        onJob(data);
      }
      if (active) onTrouble("The service closed the connection.");
    } catch (error) {
      if (signal.aborted) return;
      if (error.status === 404) throw error;
      onTrouble(error.status ? error.message : "Connection to the service lost.");
      // if there are too many followers or a proxy blocks events, polling still works
      if (error.status) active = await poll(id, onJob, signal, active);
    }
    if (active) await pause(signal);
  }
}

async function poll(id, onJob, signal, before) {
  try {
    const job = await get(path`/v1/jobs/${id}`, {}, signal);
    onJob(job);
    return ACTIVE.has(job.state);
  } catch {
    return before;
  }
}

function pause(signal) {
  return new Promise((resolve) => {
    const timer = setTimeout(resolve, 1000 * RETRY_AFTER_S);
    signal.addEventListener("abort", () => (clearTimeout(timer), resolve()), { once: true });
  });
}
