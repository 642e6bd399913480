/** Files that are photographs, of which browsers do not show every kind. */

import { Problem, getBlob } from "./api.js";

export const PHOTOGRAPHS = "image/*,.heic,.heif,.dng,.cr2,.nef,.arw";

/** @param {File} file */
export function mediaTypeOf(file) {
  // the service looks at the bytes where no kind is told
  return file.type.startsWith("image/") ? file.type : "application/octet-stream";
}

/**
 * A photograph that the browser does not show, HEIC or raw, as the service reads it.
 *
 * @param {File} file
 * @param {number} longestPx
 * @returns {Promise<Blob | null>} a JPEG; null where the service cannot read it either
 */
export async function previewOf(file, longestPx) {
  const headers = { "Content-Type": mediaTypeOf(file) };
  try {
    return await getBlob(`photographs/preview?longest_px=${longestPx}`, { method: "POST", headers, body: file, asks: false });
  } catch (error) {
    if (error instanceof Problem) return null; // what is wrong is told where depth or circles are asked for
    throw error;
  }
}
