// Details of a picture, over everything else: how it was made, the files to take away; and for who took it of the wrong eye.

import { icon } from "../icons.js";
import { html, nothing } from "../vendor/lit-html.js";
import { number, t } from "../words.js";

const dialog = () => document.querySelector("#details");
export const open = () => dialog()?.showModal();
const close = () => dialog()?.close();

export function sheet({ grey, visit }, act, { capture: { id, report, calibration_id: calibration, links }, slot, eye }) {
  const total = Object.values(report.seconds ?? {}).reduce((sum, part) => sum + part, 0);
  const rows = [
    ["method", report.method],
    ["rounds", report.rounds],
    ["stopped", report.stopped],
    ["seconds", t("detail.seconds.value", { s: number(total, 2) })],
    ["calibration", calibration],
    ["id", id],
  ];
  const move = () => {
    close();
    act.otherEyeIs(slot, id);
  };
  return html`<dialog id="details" aria-labelledby="details-title">
    <h2 id="details-title">${t("result.details")}</h2>
    ${(report.warnings ?? []).map((one) => html`<p class="warning">${icon("warn")} ${one}</p>`)}
    ${grey ? html`<p class="muted">${t("result.grey")}</p>` : nothing}
    <dl>${rows.map(([key, value]) => html`<dt>${t(`detail.${key}`)}</dt><dd>${value}</dd>`)}</dl>
    <p class="links">
      ${visit?.finished_at
        ? nothing
        : html`<button type="button" id="other-eye" @click=${move}>
            ${t("result.othereye", { other: t(`eye.${eye === "OD" ? "OS" : "OD"}.word`) })}
          </button>`}
      ${["picture", "raw", "report"].map((key) => html`<a class="button" href=${links[key]} download>${t(`detail.${key}`)}</a>`)}
    </p>
    <button class="primary" type="button" @click=${close}>${t("menu.close")}</button>
  </dialog>`;
}
