// The service's API over fetch. Errors are ApiError with what the service said; 401 asks for a key and tries again.

import { askForKey, key } from "./keys.js";

/** What the service refused, or "unreachable" where it does not answer. */
export class ApiError extends Error {
  constructor(status, code, message, detail = []) {
    super(message);
    Object.assign(this, { name: "ApiError", status, code, detail });
  }
}

export const get = (path, params, signal) => send("GET", path, { params, signal });
export const post = (path, body, signal) => send("POST", path, { body, signal });
export const put = (path, body, signal) => send("PUT", path, { body, signal });
export const del = (path, signal) => send("DELETE", path, { signal });

/** A path with what was put in made safe: path`/v1/models/${name}`. */
export function path(parts, ...values) {
  return parts.reduce((all, part, index) => all + encodeURIComponent(values[index - 1]) + part);
}

/** Items of a list, newest first, from as many pages as it takes, at most `limit`. */
export async function pages(address, limit = 200, params = {}, signal = undefined) {
  const found = [];
  let cursor = null;
  do {
    const page = await get(address, { ...params, ...(cursor ? { cursor } : {}) }, signal);
    found.push(...page.items);
    cursor = page.next_cursor;
  } while (cursor && found.length < limit);
  return found.slice(0, limit);
}

/** Server-sent events as {event, data}, until the answer ends or the signal aborts; throws ApiError where refused. */
export async function* events(address, signal) {
  const answer = await request("GET", address, { signal, headers: { accept: "text/event-stream" } });
  const reader = answer.body.pipeThrough(new TextDecoderStream()).getReader();
  let text = "";
  try {
    for (;;) {
      const { value, done } = await reader.read();
      if (done) return;
      text = (text + value).replaceAll("\r\n", "\n");
      const blocks = text.split("\n\n");
      text = blocks.pop();
      for (const block of blocks) {
        const found = { event: "message", data: "" };
        for (const line of block.split("\n")) {
          if (line.startsWith("event:")) found.event = line.slice(6).trim();
          else if (line.startsWith("data:")) found.data += line.slice(5).trim();
        }
        if (found.data) yield { event: found.event, data: JSON.parse(found.data) };
      }
    }
  } finally {
    reader.cancel().catch(() => {});
  }
}

/** Upload a File, a recording unless `where` says else, and return what was made; onProgress is told the share sent. */
export async function upload(file, params = {}, onProgress = () => {}, signal = undefined, where = "/v1/datasets") {
  const form = new FormData();
  form.append("file", file, file.name);
  for (;;) {
    const answer = await sent(form, address(where, params), onProgress, signal);
    if (answer.status === 401 && (await askForKey(message(answer.body)))) continue;
    if (answer.status >= 200 && answer.status < 300) return answer.body;
    throw refused(answer.status, answer.body);
  }
}

// fetch cannot tell how much of an upload has left; XMLHttpRequest can
function sent(form, url, onProgress, signal) {
  return new Promise((resolve, reject) => {
    const asked = new XMLHttpRequest();
    asked.open("POST", url);
    for (const [name, value] of Object.entries(authorization())) asked.setRequestHeader(name, value);
    asked.upload.onprogress = (event) => event.lengthComputable && onProgress(event.loaded / event.total);
    asked.onload = () => resolve({ status: asked.status, body: parsed(asked.responseText) });
    asked.onerror = () => reject(unreachable());
    asked.onabort = () => reject(new DOMException("the upload was stopped", "AbortError"));
    signal?.addEventListener("abort", () => asked.abort());
    asked.send(form);
  });
}

async function send(method, where, { params, body, signal }) {
  const headers = body === undefined ? {} : { "content-type": "application/json" };
  const content = body === undefined ? undefined : JSON.stringify(body);
  const answer = await request(method, address(where, params), { signal, headers, body: content });
  return answer.status === 204 ? null : answer.json();
}

async function request(method, url, { signal, headers = {}, body }) {
  for (;;) {
    let answer;
    try {
      answer = await fetch(url, { method, body, signal, headers: { ...headers, ...authorization() } });
    } catch (error) {
      if (error.name === "AbortError") throw error;
      throw unreachable();
    }
    if (answer.ok) return answer;
    const said = parsed(await answer.text());
    if (answer.status === 401 && (await askForKey(message(said)))) continue;
    throw refused(answer.status, said);
  }
}

function address(where, params = {}) {
  const given = Object.entries(params ?? {}).filter(([, value]) => value !== null && value !== undefined && value !== "");
  return given.length ? `${where}?${new URLSearchParams(given)}` : where;
}

function authorization() {
  return key() ? { authorization: `Bearer ${key()}` } : {};
}

function parsed(text) {
  try {
    return JSON.parse(text);
  } catch {
    return null;
  }
}

function message(body) {
  return body?.error?.message ?? "";
}

function refused(status, body) {
  const error = body?.error;
  return new ApiError(status, error?.code ?? "unknown", error?.message ?? `the service answered ${status}`, error?.detail);
}

function unreachable() {
  return new ApiError(0, "unreachable", "the service does not answer: is it running, and is this machine connected to it?");
}
