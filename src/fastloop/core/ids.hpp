#pragma once

#include <compare>
#include <cstdint>
#include <functional>
#include <limits>

namespace fastloop {

/// Strong integer id. Two ids of different kinds do not convert into each other; a default id is
/// invalid.
template <class Tag>
class Id {
 public:
  using Value = std::uint32_t;
  static constexpr Value kInvalidValue = std::numeric_limits<Value>::max();

  constexpr Id() = default;
  constexpr explicit Id(Value value) : value_(value) {}

  constexpr Value value() const { return value_; }
  constexpr bool valid() const { return value_ != kInvalidValue; }
  constexpr auto operator<=>(const Id&) const = default;

 private:
  Value value_ = kInvalidValue;
};

using KeyframeId = Id<struct KeyframeTag>;
using LandmarkId = Id<struct LandmarkTag>;
using MapId = Id<struct MapTag>;
using FrameId = Id<struct FrameTag>;

}  // namespace fastloop

template <class Tag>
struct std::hash<fastloop::Id<Tag>> {
  std::size_t operator()(fastloop::Id<Tag> id) const noexcept {
    return std::hash<std::uint32_t>{}(id.value());
  }
};
