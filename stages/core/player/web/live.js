export function startLive() { return null; }
