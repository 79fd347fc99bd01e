// Pictures of one patient with their montages, and comparison of two of them with synchronised zoom. Loaded on demand.

import { colourLink, finalPicture, montagePictureUrl, visitZipUrl } from "../core/api.js";
import { visitChanges } from "../components/visit_changes.js";
import { outcomeTexts, reopenButton } from "./outcome.js";
import { icon } from "../components/icons.js";
import { choice, slotLabel, thumb, whyGreen } from "../components/components.js";
import { displayNumber } from "../core/numbers.js";
import { html, nothing } from "../vendor/lit-html.js";
import { clockTime, t } from "../i18n/translate.js";

/** @typedef {import("../core/state.js").State} State */

/** @param {State} state */
export function pictures(state, actions) {
  const { visit, picked } = state;
  if (!visit) return nothing;
  const taken = Object.entries(visit.slots).flatMap(([slot, { captures }]) => captures.map((id) => ({ slot, id })));
  return html`
    <section class="pictures">
      <h2>${t("pictures.title", { number: displayNumber(visit.number) })}</h2>
      ${visit.outcome ? html`<p>${outcomeTexts(visit.outcome).join(" · ")}</p>` : nothing}
      ${whyGreen(visit) ? html`<p class="muted" id="green">${whyGreen(visit)}</p>` : nothing}
      ${taken.length ? html`<ul>${taken.map((capture) => captureItem(state, actions, capture))}</ul>` : html`<p>${t("pictures.none")}</p>`}
      ${Object.entries(state.montages).map(([eye, made]) => montage(visit, actions, eye, made))}
      <div class="ends">
        ${picked.length === 2
          ? html`<button class="primary" type="button" id="compare" @click=${actions.compare}>${t("pictures.compare")}</button>`
          : taken.length > 1
            ? html`<p class="muted">${t("pictures.pick", { count: 2 - picked.length })}</p>`
            : nothing}
        ${visit.finished_at
          ? reopenButton(visit, actions)
          : html`<button type="button" @click=${() => actions.resume(visit)}>
              ${t("home.continue", { number: displayNumber(visit.number) })}
            </button>`}
      </div>
      ${taken.length ? exportControls(visit, state, actions) : nothing} ${visitChanges(state, actions)}
    </section>
  `;
}

/**
 * Return eye, field and, of several, the number of a capture.
 * @param {State} state
 */
function captureLabel(state, id) {
  const found = Object.entries(state.visit?.slots ?? {}).find(([, slotState]) => slotState.captures.includes(id));
  if (!found) return "";
  const [slot, { captures }] = found;
  return t(captures.length > 1 ? "pictures.name.n" : "pictures.name", { ...slotLabel(state, slot), count: captures.indexOf(id) + 1 });
}

/** Return whether this capture, of several, is the one in use. */
const isUsed = ({ visit }, id) =>
  Object.values(visit?.slots ?? {}).some(({ capture, captures }) => capture === id && captures.length > 1);
/** @param {State} state */
const usedMark = (state, id) =>
  isUsed(state, id) ? html`<span class="used">${icon("check")} ${t("pictures.used")}</span>` : nothing;

/** @param {State} state */
function captureItem(state, actions, { slot, id }) {
  const on = state.picked.includes(id);
  return html`<li>
    <button type="button" class="open" data-id=${id} @click=${() => actions.openPicture(slot, id)}>
      <span class="thumb">${thumb(state.visit, id, actions)}</span> <span>${captureLabel(state, id)}</span>
      ${usedMark(state, id)}
    </button>
    <button type="button" class="pick" aria-pressed=${on} @click=${() => actions.pick(id)}>
      ${icon(on ? "check" : "circle")} ${t(on ? "pictures.picked" : "pictures.compare")}
    </button>
  </li>`;
}

/**
 * Montage of one eye: the joined pictures, or the reason why there are none; nothing without pictures of this eye.
 * @param {import("../core/state.js").Visit} visit
 */
function montage(visit, actions, eye, { state, digest, pictures, placed }) {
  if (!pictures) return nothing;
  const used = placed.filter((picture) => picture.used).length;
  const text = t(`montage.${state}`, { count: used });
  const leftOut = state === "joined" && used < pictures ? t("montage.leftout") : "";
  return html`<figure class="montage" data-eye=${eye} data-state=${state}>
    <figcaption><b>${t(`eye.${eye}`)}</b> <span aria-live="polite">${text} ${leftOut}</span></figcaption>
    ${state === "joined"
      ? html`<eye-pic
          aria-label=${t("montage.name", { eye: t(`eye.${eye}`), count: used })}
          .subject=${digest}
          .src=${{ url: montagePictureUrl(visit.id, eye, digest), mark: "final" }}
          @fault=${actions.pictureFault}
        ></eye-pic>`
      : nothing}
  </figure>`;
}

/**
 * @param {import("../core/state.js").Visit} visit
 * @param {State} state
 */
function exportControls(visit, { folders, copied, zipped }, actions) {
  const message = copied ? t("pictures.copied", { folder: copied }) : folders?.length === 0 ? t("pictures.nofolder") : "";
  return html`
    <div class="ends">
      <a class="button" href=${visitZipUrl(visit.id)} download @click=${actions.zipped}>${t("pictures.zip")}</a>
      <button type="button" id="copy" @click=${actions.listFolders}>${t("pictures.copy")}</button>
      ${(folders ?? []).map(
        (stick) => html`<button
          type="button"
          data-folder=${stick.id}
          ?disabled=${!stick.is_writable}
          @click=${() => actions.copyTo(stick)}
        >
          ${stick.is_writable ? stick.name : t("pictures.readonly", stick)}
        </button>`,
      )}
    </div>
    <p role="note">${zipped ? t("pictures.zipped") : message}</p>
  `;
}

// ---- comparison: side by side, or one over the other

/** @param {State} state */
export function compare(state, actions) {
  const { blink, redfree, loupe, route, front = 0 } = state;
  return html`
    <section class="compare" ?data-blink=${blink}>
      <div class="ends">
        ${choice({
          label: t("compare.title"),
          value: Boolean(blink),
          options: [
            [false, t("compare.side")],
            [true, t("compare.blink")],
          ],
          choose: actions.setBlink,
        })}
        <button type="button" aria-pressed=${redfree} @click=${() => actions.setRedfree(!redfree)}>${t("tool.redfree")}</button>
        <button type="button" id="loupe" aria-pressed=${loupe} @click=${() => actions.setLoupe(!loupe)}>${t("tool.loupe")}</button>
        ${blink
          ? html`<button class="primary" type="button" id="swap" data-repeat @click=${actions.swap}>
              ${t("compare.swap", { name: captureLabel(state, front ? route.capture : route.other) })}
            </button>`
          : nothing}
      </div>
      <div class="two">${[0, 1].map((i) => comparedPicture(state, actions, i))}</div>
    </section>
  `;
}

/** @param {State} state */
function comparedPicture(state, actions, i) {
  const { route, status, blink, front = 0, redfree, loupe } = state;
  const id = [route.capture, route.other][i];
  const taken = state.compared.find((capture) => capture.id === id);
  return html`<figure class=${blink && i !== front ? "behind" : ""}>
    <figcaption><b>${captureLabel(state, id)}</b> ${taken ? clockTime(taken.taken_at) : nothing} ${usedMark(state, id)}</figcaption>
    <eye-pic
      aria-label=${captureLabel(state, id)}
      .head=${status}
      .subject=${id}
      .redfree=${redfree && !(taken && colourLink(taken, 0, state.visit))}
      .loupe=${loupe}
      .src=${taken ? finalPicture(taken, redfree, state.visit) : null}
      @looked=${actions.linkZoom}
      @loupe=${actions.loupeChanged}
    ></eye-pic>
  </figure>`;
}
