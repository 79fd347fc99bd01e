// Where the person is, as the address: a reload comes back here, and the browser's Back is one step.

/**
 * @typedef {{screen: string, visit?: string, slot?: string, capture?: string, other?: string, day?: string}} Route
 * #/ · #/find · #/send · #/history[/DAY] · #/visit/ID/{person|outcome|film} · …/aim/SLOT · …/picture/SLOT[/CAPTURE]
 * · …/compare/CAPTURE/OTHER
 */
const VISIT_SCREENS = {
  person: [],
  aim: ["slot"],
  picture: ["slot", "capture"],
  outcome: [],
  film: [],
  compare: ["capture", "other"],
};
const OPTIONAL = new Set(["capture picture"]);

/** @returns {Route} the place an address names; an address that names none is Home. */
export function routeFrom(hash) {
  const [head, ...rest] = hash.replace(/^#?\/?/, "").split("/").map(unescaped);
  if (head === "find" || head === "send") return { screen: head };
  if (head === "history") return rest[0] ? { screen: "history", day: rest[0] } : { screen: "history" };
  const [visit, screen = "person", ...parts] = rest;
  const names = VISIT_SCREENS[screen];
  if (head !== "visit" || !visit || !names) return { screen: "home" };
  const route = { screen, visit };
  for (const [i, name] of names.entries()) {
    if (parts[i]) route[name] = parts[i];
    else if (!OPTIONAL.has(`${name} ${screen}`)) return { screen: "person", visit };
  }
  return route;
}

function unescaped(part) {
  try {
    return decodeURIComponent(part);
  } catch {
    return "";
  }
}

export function hashOf({ screen, visit, day, ...more }) {
  if (screen === "home") return "#/";
  if (!visit) return `#/${[screen, day].filter(Boolean).map(encodeURIComponent).join("/")}`;
  const parts = VISIT_SCREENS[screen].map((name) => more[name]).filter(Boolean);
  return `#/visit/${[visit, screen, ...parts].map(encodeURIComponent).join("/")}`;
}

let arrive = () => {};

/** Go on to a place: one more step that Back undoes, unless it only replaces where we are. */
export function go(route, { replace = false } = {}) {
  const hash = hashOf(route);
  const depth = history.state?.depth ?? 0; // how many steps there are behind us within the page
  if (replace || hash === location.hash) history.replaceState({ depth }, "", hash);
  else history.pushState({ depth: depth + 1 }, "", hash);
  arrive(routeFrom(hash));
}

/** Call `then(route)` now and whenever the place changes. */
export function follow(then) {
  arrive = then;
  addEventListener("popstate", () => arrive(routeFrom(location.hash)));
  arrive(routeFrom(location.hash));
}
