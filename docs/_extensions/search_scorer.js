/* Order of search results (html_search_scorer): pages whose title contains the words of the query come first, then guides,
 * then the glossary, and last pages that only use the terms: API entries, theory, examples and measurements. */
const supporting = {reference: -10, gallery: -8, coming_from: -8, performance: -6, theory: -4, glossary: -2};
const stems = (text) => {
  const words = text.toLowerCase().split(/[^\p{L}\p{N}]+/u).filter((word) => word && !stopwords.has(word));
  return new Set(words.map((word) => new Stemmer().stemWord(word)));
};

var Scorer = {
  score: ([docname, title, anchor, description, score, filename, kind]) => {
    const query = stems(new URLSearchParams(location.search).get("q") || "");
    const heading = stems(kind === "object" ? "" : title);
    const matched = [...query].filter((word) => heading.has(word)).length;
    const group = docname === "reference/index" || docname === "performance" ? "" : docname.split(/[/_]/)[0];
    const section = docname.startsWith("coming_from") ? "coming_from" : group;
    return score + (10 * matched) / Math.max(query.size, 1) + (supporting[section] || 0);
  },
  // Defaults of Sphinx.
  objNameMatch: 11,
  objPartialMatch: 6,
  objPrio: {0: 15, 1: 5, 2: -5},
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 2,
};
