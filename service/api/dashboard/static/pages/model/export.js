// Downloads of a version in a format of the API. They are fetched with the API key and saved as files.

import { ApiError } from "../../api.js";
import { key } from "../../keys.js";

/** Formats of an arm, with their labels. */
export const ARM_FORMATS = { urdf: "URDF", mjcf: "MJCF (MuJoCo)", c: "C" };

/** Formats of a function of any estimator, with their labels. */
export const FUNCTION_FORMATS = { onnx: "ONNX", torch: "PyTorch", jax: "JAX" };

/** Save a version in a format: `archive`, or one of ARM_FORMATS or FUNCTION_FORMATS. */
export async function exportVersion(name, version, format = "archive") {
  const headers = key() ? { authorization: `Bearer ${key()}` } : {};
  const answer = await fetch(`/v1/models/${encodeURIComponent(name)}/export?version=${version}&format=${format}`, { headers });
  if (!answer.ok) {
    const error = (await answer.json()).error;
    throw new ApiError(answer.status, error.code, error.message, error.detail);
  }
  const address = URL.createObjectURL(await answer.blob());
  const file = /filename="?([^";]+)"?/.exec(answer.headers.get("content-disposition") ?? "")?.[1];
  Object.assign(document.createElement("a"), { href: address, download: file ?? `${name}-v${version}` }).click();
  setTimeout(() => URL.revokeObjectURL(address), 60_000);
}
