// Following a job: its events as long as the connection holds, and again when it is back.

import { events, get, path } from "../../api.js";
import { ACTIVE } from "./words.js";

const PAUSE_S = 2;

/**
 * Tell every change of a job until it has ended or the signal aborts.
 * onJob(job): each news; onTrouble(text): why there is none for now.
 */
export async function follow(id, { onJob, onTrouble, signal }) {
  let active = true;
  while (active && !signal.aborted) {
    try {
      for await (const { data } of events(path`/v1/jobs/${id}/events`, signal)) {
        active = ACTIVE.has(data.state);
        onJob(data);
      }
      if (active) onTrouble("The service ended the connection.");
    } catch (error) {
      if (signal.aborted) return;
      if (error.status === 404) throw error;
      onTrouble(error.status ? error.message : "The connection to the service is lost.");
      // too many follow already, or a proxy lets no events through: asking now and then still works
      if (error.status) active = await asked(id, onJob, signal, active);
    }
    if (active) await pause(signal);
  }
}

async function asked(id, onJob, signal, before) {
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
    const timer = setTimeout(resolve, 1000 * PAUSE_S);
    signal.addEventListener("abort", () => (clearTimeout(timer), resolve()), { once: true });
  });
}
