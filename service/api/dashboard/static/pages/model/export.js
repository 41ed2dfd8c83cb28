// Downloads of a version: archive, C code, URDF. They are fetched with the API key and saved as files.

import { ApiError } from "../../api.js";
import { key } from "../../keys.js";

/** Save a version's archive. */
export function exportVersion(name, version) {
  return save(name, version, "export", "tar");
}

/** Save the learnt arm of a version as a URDF. */
export function saveUrdf(name, version) {
  return save(name, version, "urdf", "urdf");
}

/** Save a version as C99: an archive of two files. */
export function saveC(name, version) {
  return save(name, version, "export", "tar", "&format=c");
}

async function save(name, version, what, ending, more = "") {
  const headers = key() ? { authorization: `Bearer ${key()}` } : {};
  const answer = await fetch(`/v1/models/${encodeURIComponent(name)}/${what}?version=${version}${more}`, { headers });
  if (!answer.ok) {
    const error = (await answer.json()).error;
    throw new ApiError(answer.status, error.code, error.message, error.detail);
  }
  const address = URL.createObjectURL(await answer.blob());
  const file = /filename="?([^";]+)"?/.exec(answer.headers.get("content-disposition") ?? "")?.[1];
  Object.assign(document.createElement("a"), { href: address, download: file ?? `${name}-v${version}.${ending}` }).click();
  setTimeout(() => URL.revokeObjectURL(address), 60_000);
}
