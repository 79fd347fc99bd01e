// Status of the instrument and control lease of this page: requested again with the heartbeat, shown as alerts.

import { requestControl, getStatus, releaseControl, ApiError } from "./api.js";
import { lowerAlert, lowerAlerts, raiseAlert, syncNotices } from "./alerts.js";
import { resolveCutCaptures } from "./capture.js";
import { get, set } from "./state.js";
import { t } from "../i18n/translate.js";

/** @typedef {import("./state.js").State} State */

// The age on the live picture already shows a cut light; the next frame follows. And `light.visit` refuses light
// without a visit only, while every picture of this page has one.
const UNSHOWN_PROBLEMS = ["light.cut", "light.visit"];

/** Request the status and show its problem and its alerts; without an answer the event stream shows the lost connection. */
export async function refreshStatus() {
  const { noticeCount } = get();
  let status;
  try {
    status = await getStatus();
  } catch (problem) {
    if (!(problem instanceof ApiError)) throw problem;
    return;
  }
  const { problem } = status;
  set({ status: Object.freeze(status), activity: status.state });
  lowerAlerts(({ from, problemCode }) => from === "status" && problemCode !== problem?.code);
  if (problem && !UNSHOWN_PROBLEMS.includes(problem.code)) raiseAlert({ ...problem, problemCode: problem.code, from: "status" });
  if (get().noticeCount === noticeCount) syncNotices(status.standing ?? []); // otherwise `status.standing` is older than the latest notice event
  resolveCutCaptures();
  raiseFindings(status.notices ?? []);
  if (status.swept?.length && !get().interruptedShown) raiseInterrupted(status.swept);
  await renewControl();
}

// Show findings of the instrument's self-checks that do not block captures, with the server's text.
function raiseFindings(notices) {
  lowerAlerts(({ from, message }) => from === "finding" && !notices.includes(message));
  for (const message of notices.filter((text) => !get().shownFindings.includes(text))) {
    const shownFindings = Object.freeze([...get().shownFindings, message]);
    set({ shownFindings });
    raiseAlert({ code: `finding.${shownFindings.length}`, level: "tell", rank: 99, message, buttons: ["later"], from: "finding" });
  }
}

function raiseInterrupted(swept) {
  set({ interruptedShown: true });
  const [first] = swept;
  const known = swept.length === 1 && first.slot ? first : { buttons: ["ok"] };
  raiseAlert({ code: "power.lost", message: t("swept", { count: swept.length }), ...known, from: "page" });
}

// Screens that show what was taken. A page on one of them never takes the camera, and releases it.
const READING = ["outcome", "pictures", "compare", "history", "send"];

/**
 * Return whether this page needs the control lease: it aims, or a picture of its own is being taken.
 * @param {State} state
 */
const needsControl = ({ route, captures }) => route.screen === "aim" || captures.some((capture) => !capture.over && !capture.reloaded);

/** @param {State} state */
const isReading = ({ route, visit }) => READING.includes(route.screen) || (route.screen === "picture" && Boolean(visit?.finished_at));

/** Request or renew the control lease where this page needs it; between two pictures renew it where it is held. */
export async function renewControl() {
  if (!needsControl(get()) && (isReading(get()) || !get().hasControl)) {
    if (get().hasControl) releaseControl();
    set({ hasControl: false });
    return lowerAlerts(({ code, from }) => code === "link.other" && from === "page");
  }
  try {
    setControl(await requestControl(false));
  } catch (problem) {
    if (!(problem instanceof ApiError)) throw problem;
  }
}

/**
 * Show whether this page holds the control lease.
 * @param {{mine: boolean}} answer
 */
export function setControl({ mine }) {
  set({ hasControl: mine });
  if (mine) lowerAlert("link.other");
  else if (needsControl(get())) raiseAlert({ code: "link.other", from: "page" });
}
