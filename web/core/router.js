// Hash router: the address holds screen, visit, slot and capture, so a reload restores the screen and Back is one step.

/**
 * @typedef {{screen: string, visit?: string, slot?: string, capture?: string, other?: string, day?: string}} Route
 * #/ · #/find · #/send · #/history[/DAY] · #/visit/ID/{patient|outcome|pictures} · …/aim/SLOT · …/picture/SLOT[/CAPTURE]
 * · …/compare/CAPTURE/OTHER
 */
const VISIT_SCREENS = {
  patient: [],
  aim: ["slot"],
  picture: ["slot", "capture"],
  outcome: [],
  pictures: [],
  compare: ["capture", "other"],
};
const OPTIONAL = new Set(["capture picture"]);

/** @returns {Route} the route of a hash; Home for an unknown one. */
export function parseRoute(hash) {
  const [head, ...rest] = hash.replace(/^#?\/?/, "").split("/").map(decoded);
  if (head === "find" || head === "send") return { screen: head };
  if (head === "history") return rest[0] ? { screen: "history", day: rest[0] } : { screen: "history" };
  const [visit, screen = "patient", ...parts] = rest;
  const names = VISIT_SCREENS[screen];
  if (head !== "visit" || !visit || !names) return { screen: "home" };
  const route = { screen, visit };
  for (const [i, name] of names.entries()) {
    if (parts[i]) route[name] = parts[i];
    else if (!OPTIONAL.has(`${name} ${screen}`)) return { screen: "patient", visit };
  }
  return route;
}

function decoded(part) {
  try {
    return decodeURIComponent(part);
  } catch {
    return "";
  }
}

/** Return the hash of a route. */
export function routeHash({ screen, visit, day, ...more }) {
  if (screen === "home") return "#/";
  if (!visit) return `#/${[screen, day].filter(Boolean).map(encodeURIComponent).join("/")}`;
  const parts = VISIT_SCREENS[screen].map((name) => more[name]).filter(Boolean);
  return `#/visit/${[visit, screen, ...parts].map(encodeURIComponent).join("/")}`;
}

/** @type {(route: Route) => void} */
let onRoute = () => {};

/** Navigate to a route: push a history entry, or replace the current one. */
export function navigate(route, { replace = false } = {}) {
  const hash = routeHash(route);
  const depth = history.state?.depth ?? 0; // number of history entries of this page behind the current one
  if (replace || hash === location.hash) history.replaceState({ depth }, "", hash);
  else history.pushState({ depth: depth + 1 }, "", hash);
  onRoute(parseRoute(hash));
}

/** Call `listener(route)` now and at each route change. */
export function startRouter(listener) {
  onRoute = listener;
  addEventListener("popstate", () => onRoute(parseRoute(location.hash)));
  onRoute(parseRoute(location.hash));
}
