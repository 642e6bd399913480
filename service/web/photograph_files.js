/** Files that are photographs. */

export const PHOTOGRAPHS = "image/*,.heic,.heif,.dng,.cr2,.nef,.arw";

/** @param {File} file */
export function mediaTypeOf(file) {
  // the service looks at the bytes where no kind is told
  return file.type.startsWith("image/") ? file.type : "application/octet-stream";
}
