// Send screen: upload queue with the error of each visit, and "try now". Loaded on demand.

import { sentences } from "../core/api.js";
import { icon } from "../components/icons.js";
import { html, nothing } from "../vendor/lit-html.js";
import { calendarDay, clockTime, has, number, t } from "../i18n/translate.js";

export function send({ uploadQueue }, actions) {
  if (!uploadQueue) return nothing;
  const { configured, sent, waiting, visits, next_try_s: wait } = uploadQueue;
  return html`
    <section class="send">
      <h2>${t("send.title")}</h2>
      <div aria-live="polite">
        <p class="verdict">${icon(waiting ? "wait" : "check")} ${t(headlineKey(configured, waiting), { count: waiting })}</p>
        ${configured ? html`<p>${t("send.today", { count: sent })} ${waiting ? nextTryText(wait) : ""}</p>` : nothing}
      </div>
      ${waiting
        ? html`<button class="primary" type="button" id="try-now" @click=${() => actions.retryUploads()}>
            ${icon("again")} ${t("do.tryNow")}
          </button>`
        : nothing}
      <ul class="people">${visits.map((visit) => queuedVisit(visit, actions))}</ul>
    </section>
  `;
}

const headlineKey = (configured, waiting) => (!configured ? "send.off" : waiting ? "send.waiting" : "send.none");

const nextTryText = (wait) => (wait > 0 ? t("send.next", { count: Math.ceil(wait / 60) }) : t("send.soon"));

function queuedVisit({ visit, number: who, since, size_bytes: size, tries, error, stuck }, actions) {
  return html`<li data-stuck=${stuck}>
    <button type="button" data-visit=${visit} @click=${() => actions.go({ screen: "pictures", visit })}>
      <span>${who}</span> <span class="muted">${calendarDay(since)}, ${clockTime(since)}</span>
      <span class="end">
        ${t("send.size", { count: number(size / 1e6) })}${tries ? ` · ${t("send.tries", { count: tries })}` : ""}
      </span>
    </button>
    ${error ? errorLine(error, stuck) : nothing}
  </li>`;
}

function errorLine({ code, message, remedy }, stuck) {
  const known = `why.${code}`;
  return html`<p class="why">${icon(stuck ? "warn" : "wait")} <span>${has(known) ? t(known) : sentences({ message, remedy })}</span></p>`;
}
