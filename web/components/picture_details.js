// Details dialog of a picture: reconstruction data, files to download, and the change to the other eye.

import { madeText, versionName, whyGreen } from "./components.js";
import { icon } from "./icons.js";
import { html, nothing } from "../vendor/lit-html.js";
import { number, t } from "../i18n/translate.js";

const dialog = () => /** @type {HTMLDialogElement | null} */ (document.querySelector("#details"));
export const open = () => dialog()?.showModal();
const close = () => dialog()?.close();

// A predicted channel was computed from the others; one with a reason is not in the picture.
function channelText({ name, predicted, reason }) {
  const colour = t(`colour.${name}`);
  if (predicted) return t("detail.channels.predicted", { colour });
  return reason ? t("detail.channels.missing", { colour }) : colour;
}

const signed = (dpt) => `${dpt < 0 ? "−" : "+"}${number(Math.abs(dpt), 2)}`;

/**
 * Return the refraction of a report as text: sphere / cylinder x axis, or the mean sphere of a report without a cylinder;
 * with a second sentence where the calibration does not fix its zero.
 */
export function refractionText({ sphere, sd, sphere_sc: sphereOfCylinder, cylinder, axis_deg: axis, zero = null, refused = null }) {
  if (refused !== null || sphere == null || sd == null) return t("detail.refraction.none");
  const mean = { mean: signed(sphere), sd: number(sd, 2) };
  const text =
    cylinder == null
      ? t("detail.refraction.mean", mean)
      : t("detail.refraction.value", { ...mean, sphere: signed(sphereOfCylinder), cylinder: signed(cylinder), axis: number(axis, 0) });
  return zero === "relative" ? `${text}. ${t("detail.refraction.relative")}` : text;
}

function psfText({ gain_db: gain = null }) {
  return gain === null ? t("detail.psf.cylinder") : t("detail.psf.gain", { db: number(gain, 1) });
}

// The names are those of `diffuscope simulate`, which says why each effect is simulated or not.
const effectsText = ({ names, known }) => t("detail.effects.value", { some: names.length, all: known, names: names.join(", ") });

function detailRows({ id, report, calibration_id: calibration, links }) {
  const frames = report.frames ?? [];
  const used = frames.filter((frame) => frame.used).length;
  const channels = report.channels ?? [];
  const light = report.verdict?.numbers.light_e_per_um2;
  return [
    ...(report.device?.head ? [["head", report.device.head]] : []),
    ...(light === undefined ? [] : [["light", t("detail.light.value", { light: number(light, 1) })]]),
    ["method", report.method],
    ["rounds", report.rounds],
    ["stopped", report.stopped],
    ...(frames.length ? [["frames", t("detail.frames.value", { used, all: frames.length })]] : []),
    ...(channels.length ? [["channels", channels.map(channelText).join(", ")]] : []),
    ...(links.colour ? [["hue", t(channels.some((channel) => channel.white_ratio != null) ? "detail.hue.card" : "detail.hue.neutral")]] : []),
    ...(report.refraction_dpt ? [["refraction", refractionText(report.refraction_dpt)]] : []),
    ...(report.psf_cylinder ? [["psf", psfText(report.psf_cylinder)]] : []),
    ...(report.effects ? [["effects", effectsText(report.effects)]] : []),
    ...(madeText(report) ? [["seconds", madeText(report)]] : []),
    ["calibration", calibration],
    ["id", id],
  ];
}

export function detailsDialog({ grey, visit }, actions, { record, slot, eye }) {
  const { id, report, links, versions = [] } = record;
  const move = () => {
    close();
    actions.moveToOtherEye(slot, id);
  };
  return html`<dialog id="details" aria-labelledby="details-title">
    <h2 id="details-title">${t("result.details")}</h2>
    ${(report.warnings ?? []).map((warning) => html`<p class="warning">${icon("warn")} ${warning}</p>`)}
    ${whyGreen(visit) ? html`<p class="muted">${whyGreen(visit)}</p>` : grey && !links.colour ? html`<p class="muted">${t("result.grey")}</p>` : nothing}
    <dl>${detailRows(record).map(([key, value]) => html`<dt>${t(`detail.${key}`)}</dt><dd>${value}</dd>`)}</dl>
    <p class="links">
      ${visit?.finished_at
        ? nothing
        : html`<button type="button" id="other-eye" @click=${move}>
            ${t("result.othereye", { other: t(`eye.${eye === "OD" ? "OS" : "OD"}.word`) })}
          </button>`}
      ${["colour", "picture", "raw", "report"].filter((key) => links[key]).map((key) => html`<a class="button" href=${links[key]} download>${t(`detail.${key}`)}</a>`)}
      ${versions.map((version) => html`<a class="button" href=${version.colour ?? version.picture} download>${versionName(version)} (PNG)</a>`)}
    </p>
    <button class="primary" type="button" @click=${close}>${t("menu.close")}</button>
  </dialog>`;
}
