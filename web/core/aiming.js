// Aiming: hints and age of the live picture, and the automatic press. At most one new prompt every 0.7 s.

import { lowerAlert, raiseAlert } from "./alerts.js";
import { playCue, takePicture } from "./capture.js";
import { get, set } from "./state.js";
import { renewControl } from "./status.js";
import { refreshVisit } from "./visit.js";

const PROMPT_MIN_MS = 700; // minimum display time of a prompt
const AUTO_CAPTURE_MS = 500;
const LATE_S = 4; // the server answers within 2 s, with a frame or without one

/**
 * Show an aiming hint; press when "ready" has lasted, if the health worker chose that.
 * @param {{code: string} | null} aim
 */
export function showAim(aim) {
  if (!aim || get().route.screen !== "aim") return;
  const now = performance.now();
  const { prompt, promptedMs, readySinceMs } = get();
  set({ readySinceMs: aim.code === "ready" ? readySinceMs || now : 0 });
  if (aim.code !== prompt?.code && now - promptedMs >= PROMPT_MIN_MS) {
    set({ prompt: Object.freeze(aim), promptedMs: now });
    if (aim.code === "ready") playCue("ready");
  }
  if (get().auto && get().prompt?.code === "ready" && get().readySinceMs && now - get().readySinceMs > AUTO_CAPTURE_MS) takePicture();
}

/** Handlers of the events of the live picture. */
export const previewActions = {
  previewAim: ({ detail }) => showAim(detail),
  // Consent or control changed on another screen: reload the visit or the lease to show the reason.
  previewRefused({ detail: { code } }) {
    if (code.startsWith("consent.")) refreshVisit(get().route.visit);
    else if (code === "link.other") renewControl();
  },
  previewLate({ detail: { frameS, linkS } }) {
    if (frameS && get().prompt) set({ prompt: null }); // an outdated frame must not show "ready"
    if (linkS >= LATE_S && get().link === "live") raiseAlert({ code: "link.slow", n: frameS, from: "page" });
    else lowerAlert("link.slow");
  },
};
